"""What depth images of the last moments showed where the newest one does not look."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

if TYPE_CHECKING:
    from planning.collision_monitor import DepthImage

# Points of one image in a cube of this edge [m] are remembered as one.
CUBE = 0.04


class RecentPoints:
    """Measured points of the last moments, as long as no newer image shows their places.

    Args:
        memory: how long points are kept [s].
        agreeing: fewer points of one image in a cube are noise.
    """

    def __init__(self, memory: float, agreeing: int) -> None:
        self.memory, self.agreeing = memory, agreeing
        self.points: Float[ndarray, "n 3"] = np.empty((0, 3))
        """Middles of the points in each cube [m]."""
        self._taken = np.empty(0)

    def add(self, image: DepthImage, points: Float[ndarray, "m 3"]) -> None:
        """Take in an image and its points [m]; forget what is old, or better known by this image."""
        kept = (image.time - self._taken <= self.memory) & ~image.sees(self.points)
        fresh = _condensed(points, self.agreeing)
        self.points = np.concatenate([self.points[kept], fresh])
        self._taken = np.concatenate([self._taken[kept], np.full(len(fresh), image.time)])


def _condensed(points: Float[ndarray, "m 3"], agreeing: int) -> Float[ndarray, "n 3"]:
    """The middle of the points in each cube that holds enough of them."""
    _, cube, count = np.unique(_cubes(points), return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(cube, points[:, axis], len(count)) for axis in range(3)], axis=1)
    return (sums / np.maximum(count, 1)[:, None])[count >= agreeing]


def _cubes(points: Float[ndarray, "m 3"]) -> ndarray:
    """A number for the cube that each point lies in."""
    x, y, z = np.floor(points / CUBE).astype(np.int64).T + (1 << 20)
    return (x << 42) + (y << 21) + z
