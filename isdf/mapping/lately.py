"""Where something has come into free space lately: it may go again, and its far side was not seen."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

# What is this near [m] to where something was seen belongs to it.
REACH = 0.1


class Lately(NamedTuple):
    """Cubes of space in which something was seen that has come.

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
        """The cubes of these indices."""
        if len(places) == 0:
            return cls(np.zeros((0, 0, 0), dtype=bool), np.zeros(3, dtype=np.int64), edge)
        corner = places.min(axis=0)
        cubes = np.zeros(places.max(axis=0) + 1 - corner, dtype=bool)
        cubes[tuple((places - corner).T)] = True
        return cls(cubes, corner, edge)

    def near(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Which points [m] lie in them or no more than `REACH` beside."""
        out = np.zeros(len(points), dtype=np.bool_)
        if self.cubes.size:
            _look_up(points, self.cubes, self.corner, self.edge, out)
        return out


@njit(cache=True, nogil=True)
@no_type_check
def _look_up(points, cubes, corner, edge, out):
    """Set `out` (n,) where a box of twice `REACH` about points (n, 3) [m] overlaps marked cubes."""
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(points.shape[0]):
        for axis in range(3):
            place = points[n, axis]
            if not np.isfinite(place):
                place = -np.float64(1e9)
            first[axis] = max(int(np.floor((place - REACH) / edge)) - corner[axis], 0)
            last[axis] = min(int(np.floor((place + REACH) / edge)) - corner[axis], cubes.shape[axis] - 1)
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    out[n] |= cubes[i, j, k]
