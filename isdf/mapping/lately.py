"""Where something has come into free space lately: it may go again, and its far side was not seen."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit


class Lately(NamedTuple):
    """Cubes of space in which surfaces have come nearer, and those beside them.

    Args:
        cubes: which.
        corner: index of the first.
        edge: of a cube [m].
    """

    cubes: Bool[np.ndarray, "nx ny nz"]
    corner: Int[np.ndarray, "3"]
    edge: float

    @classmethod
    def of(cls, places: Int[np.ndarray, "n 3"], edge: float) -> Lately:
        """The cubes of these indices, and their neighbours: what the field interpolates may lie a little beside."""
        if len(places) == 0:
            return cls(np.zeros((0, 0, 0), dtype=bool), np.zeros(3, dtype=np.int64), edge)
        corner = places.min(axis=0) - 1
        cubes = np.zeros(places.max(axis=0) + 2 - corner, dtype=bool)
        cubes[tuple((places - corner).T)] = True
        for axis in range(3):  # no marked cube lies at the rim
            cubes |= np.roll(cubes, 1, axis) | np.roll(cubes, -1, axis)
        return cls(cubes, corner, edge)

    def near(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Which points [m] lie in them."""
        out = np.zeros(len(points), dtype=np.bool_)
        if self.cubes.size:
            _look_up(points, self.cubes, self.corner, self.edge, out)
        return out


@njit(cache=True, nogil=True)
@no_type_check
def _look_up(points, cubes, corner, edge, out):
    """Set `out` (n,) where points (n, 3) [m] lie in marked cubes."""
    for n in range(points.shape[0]):
        x, y, z = (
            points[n, 0] / edge - corner[0],
            points[n, 1] / edge - corner[1],
            points[n, 2] / edge - corner[2],
        )
        if 0 <= x < cubes.shape[0] and 0 <= y < cubes.shape[1] and 0 <= z < cubes.shape[2]:
            out[n] = cubes[int(x), int(y), int(z)]
