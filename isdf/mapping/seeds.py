"""Surface points between the voxels of a brick volume."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from .bricks import Bricks, voxel_at

# Where space hidden behind the edge of a thing borders on space that another view looks through the distances cross
# zero, too, but no view ends there. With less evidence of a surface than that, four fifths of what a voxel has that
# is hidden from all views, it is none.
ENDED = 0.24


@njit(cache=True, nogil=True)
@no_type_check
def surface_seeds(bricks: Bricks, begin, end):
    """Zero crossings between observed neighbours where views end, averaged within each voxel, of a box of bricks.

    Returns:
        float32 positions (n, 3) [m], unit normals (n, 3) towards where each surface was seen from, and weights (n,).
    """
    table, corner, distances, weights, ended, voxel = bricks
    # Farther from zero than this no neighbour is across, for distances that change by at most a voxel a voxel or so.
    limit = 1.8 * voxel
    size = 4096
    points, normals, seen = (
        np.empty((size, 3), np.float32),
        np.empty((size, 3), np.float32),
        np.empty(size, np.float32),
    )
    count = 0
    shift, slope = np.empty(3), np.empty(3)
    for bi in range(begin[0], end[0]):
        for bj in range(begin[1], end[1]):
            for bk in range(begin[2], end[2]):
                brick = table[bi, bj, bk]
                if brick < 0:
                    continue
                for at in range(512):
                    here = distances[brick, at]
                    if weights[brick, at] <= 0 or abs(here) > limit or ended[brick, at] < ENDED:
                        continue
                    i = 8 * (corner[0] + bi) + at // 64
                    j = 8 * (corner[1] + bj) + (at // 8) % 8
                    k = 8 * (corner[2] + bk) + at % 8
                    shift[:], slope[:] = 0.0, 0.0
                    crossings = 0
                    for axis in range(3):
                        known = 0
                        for side in (-1, 1):
                            there, weight = voxel_at(
                                bricks,
                                i + (side if axis == 0 else 0),
                                j + (side if axis == 1 else 0),
                                k + (side if axis == 2 else 0),
                            )  # fmt: skip
                            if weight <= 0:
                                continue
                            known += 1
                            slope[axis] += side * (there - here)
                            if (here < 0) != (there < 0):
                                part = here / (here - there)
                                if part <= 0.5:
                                    shift[axis] += side * part
                                    crossings += 1
                        if known > 0:
                            slope[axis] /= known
                    length = np.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2)
                    if crossings == 0 or length <= 0:
                        continue
                    if count == size:
                        points = np.concatenate((points, np.empty_like(points)))
                        normals = np.concatenate((normals, np.empty_like(normals)))
                        seen = np.concatenate((seen, np.empty_like(seen)))
                        size *= 2
                    points[count, 0] = voxel * (i + shift[0] / crossings)
                    points[count, 1] = voxel * (j + shift[1] / crossings)
                    points[count, 2] = voxel * (k + shift[2] / crossings)
                    for axis in range(3):
                        normals[count, axis] = slope[axis] / length
                    seen[count] = weights[brick, at]
                    count += 1
    return points[:count].copy(), normals[:count].copy(), seen[:count].copy()
