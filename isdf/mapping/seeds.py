"""Surface points between the voxels of a brick volume."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def _voxel(table, corner, distances, weights, i, j, k):  # type: ignore[no-untyped-def]
    """Distance and weight of the voxel at a lattice index; weight 0 where nothing is stored."""
    a, b, c = (i >> 3) - corner[0], (j >> 3) - corner[1], (k >> 3) - corner[2]
    if a < 0 or b < 0 or c < 0 or a >= table.shape[0] or b >= table.shape[1] or c >= table.shape[2]:
        return 0.0, 0.0
    brick = table[a, b, c]
    if brick < 0:
        return 0.0, 0.0
    at = (i & 7) * 64 + (j & 7) * 8 + (k & 7)
    return distances[brick, at], weights[brick, at]


@njit(cache=True)
def surface_seeds(table, corner, distances, weights, voxel, begin, end):  # type: ignore[no-untyped-def]
    """Zero crossings between observed neighbours, averaged within each voxel, of a box of bricks.

    Returns:
        (n, 3) float32 positions [m] and (n, 3) float32 unit normals, towards where each surface was seen from.
    """
    limit = 1.8 * voxel
    size = 4096
    points, normals = np.empty((size, 3), np.float32), np.empty((size, 3), np.float32)
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
                    if weights[brick, at] <= 0 or abs(here) > limit:
                        continue
                    i = 8 * (corner[0] + bi) + at // 64
                    j = 8 * (corner[1] + bj) + (at // 8) % 8
                    k = 8 * (corner[2] + bk) + at % 8
                    shift[:], slope[:] = 0.0, 0.0
                    crossings = 0
                    for axis in range(3):
                        known = 0
                        for side in (-1, 1):
                            there, weight = _voxel(
                                table, corner, distances, weights,
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
                        size *= 2
                    points[count, 0] = voxel * (i + shift[0] / crossings)
                    points[count, 1] = voxel * (j + shift[1] / crossings)
                    points[count, 2] = voxel * (k + shift[2] / crossings)
                    for axis in range(3):
                        normals[count, axis] = slope[axis] / length
                    count += 1
    return points[:count].copy(), normals[:count].copy()
