"""Signed distances to boxes, cylinders, balls and a voxel grid, with their gradients, one point at a time."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from planning.compiled.arrays import Solids

FAR = 1e9
GROUP = 16  # points that share one test for what is close
FLOOR_SLOPE = 0.5  # least upward component of the gradient above a floor


@njit(cache=True, nogil=True)
@no_type_check
def solid_distance(table: np.ndarray, i: int, x: float, y: float, z: float) -> float:
    """Signed distance [m] of a point to solid i."""
    dx, dy, dz = x - table[i, 9], y - table[i, 10], z - table[i, 11]
    kind = table[i, 16]
    if kind == 2.0:
        return math.sqrt(dx * dx + dy * dy + dz * dz) - table[i, 12]
    a = table[i, 0] * dx + table[i, 1] * dy + table[i, 2] * dz
    b = table[i, 3] * dx + table[i, 4] * dy + table[i, 5] * dz
    c = table[i, 6] * dx + table[i, 7] * dy + table[i, 8] * dz
    if kind == 1.0:
        a = math.sqrt(a * a + b * b) - table[i, 12]
        b = -1.0
        c = abs(c) - table[i, 13]
        inside = min(max(a, c), 0.0)
    else:
        a, b, c = abs(a) - table[i, 12], abs(b) - table[i, 13], abs(c) - table[i, 14]
        inside = min(max(a, b, c), 0.0)
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return math.sqrt(a * a + b * b + c * c) + inside


@njit(cache=True, nogil=True)
@no_type_check
def beyond(table: np.ndarray, i: int, x: float, y: float, z: float, reach: float) -> bool:
    """Whether a point is further than `reach` from solid i for sure, by the ball round it."""
    dx, dy, dz = x - table[i, 9], y - table[i, 10], z - table[i, 11]
    far = reach + table[i, 15]
    return dx * dx + dy * dy + dz * dz >= far * far


@njit(cache=True, nogil=True)
@no_type_check
def solid_gradient(table: np.ndarray, i: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit gradient of `solid_distance`; a fixed direction where there are several."""
    dx, dy, dz = x - table[i, 9], y - table[i, 10], z - table[i, 11]
    kind = table[i, 16]
    if kind == 2.0:
        norm = math.sqrt(dx * dx + dy * dy + dz * dz)
        return (dx / norm, dy / norm, dz / norm) if norm > 0.0 else (1.0, 0.0, 0.0)
    a = table[i, 0] * dx + table[i, 1] * dy + table[i, 2] * dz
    b = table[i, 3] * dx + table[i, 4] * dy + table[i, 5] * dz
    c = table[i, 6] * dx + table[i, 7] * dy + table[i, 8] * dz
    if kind == 1.0:
        ga, gb, gc = _cylinder_gradient(a, b, c, table[i, 12], table[i, 13])
    else:
        ga, gb, gc = _box_gradient(a, b, c, table[i, 12], table[i, 13], table[i, 14])
    return (
        table[i, 0] * ga + table[i, 3] * gb + table[i, 6] * gc,
        table[i, 1] * ga + table[i, 4] * gb + table[i, 7] * gc,
        table[i, 2] * ga + table[i, 5] * gb + table[i, 8] * gc,
    )


@njit(cache=True, nogil=True)
@no_type_check
def _cylinder_gradient(
    a: float, b: float, c: float, radius: float, half: float
) -> tuple[float, float, float]:
    up = math.copysign(1.0, c)
    radial = math.sqrt(a * a + b * b)
    u, v = (a / radial, b / radial) if radial > 0.0 else (1.0, 0.0)
    r, h = radial - radius, abs(c) - half
    if r > 0.0 and h > 0.0:
        norm = math.sqrt(r * r + h * h)
        return u * r / norm, v * r / norm, up * h / norm
    return (u, v, 0.0) if r >= h else (0.0, 0.0, up)


@njit(cache=True, nogil=True)
@no_type_check
def _box_gradient(
    a: float, b: float, c: float, sa: float, sb: float, sc: float
) -> tuple[float, float, float]:
    da, db, dc = abs(a) - sa, abs(b) - sb, abs(c) - sc
    pa, pb, pc = max(da, 0.0), max(db, 0.0), max(dc, 0.0)
    norm = math.sqrt(pa * pa + pb * pb + pc * pc)
    if norm > 0.0:
        return math.copysign(pa / norm, a), math.copysign(pb / norm, b), math.copysign(pc / norm, c)
    if da >= db and da >= dc:
        return math.copysign(1.0, a), 0.0, 0.0
    return (0.0, math.copysign(1.0, b), 0.0) if db >= dc else (0.0, 0.0, math.copysign(1.0, c))


@njit(cache=True, nogil=True)
@no_type_check
def grid_sample(solids: Solids, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Trilinear distance and its gradient in the grid; beyond its border, the border's value and how far it is."""
    grid, low, voxel = solids.grid, solids.low, solids.voxel
    nx, ny, nz = grid.shape
    if nx == 0:
        return FAR, 0.0, 0.0, 0.0
    u, v, w = (x - low[0]) / voxel, (y - low[1]) / voxel, (z - low[2]) / voxel
    cu, cv, cw = min(max(u, 0.0), nx - 1.0), min(max(v, 0.0), ny - 1.0), min(max(w, 0.0), nz - 1.0)
    i, j, k = min(int(cu), nx - 2), min(int(cv), ny - 2), min(int(cw), nz - 2)
    a, b, c = cu - i, cv - j, cw - k
    f00 = grid[i, j, k] * (1 - c) + grid[i, j, k + 1] * c
    f01 = grid[i, j + 1, k] * (1 - c) + grid[i, j + 1, k + 1] * c
    f10 = grid[i + 1, j, k] * (1 - c) + grid[i + 1, j, k + 1] * c
    f11 = grid[i + 1, j + 1, k] * (1 - c) + grid[i + 1, j + 1, k + 1] * c
    f0, f1 = f00 * (1 - b) + f01 * b, f10 * (1 - b) + f11 * b
    back = (grid[i, j, k] * (1 - b) + grid[i, j + 1, k] * b) * (1 - a)
    back += (grid[i + 1, j, k] * (1 - b) + grid[i + 1, j + 1, k] * b) * a
    front = (grid[i, j, k + 1] * (1 - b) + grid[i, j + 1, k + 1] * b) * (1 - a)
    front += (grid[i + 1, j, k + 1] * (1 - b) + grid[i + 1, j + 1, k + 1] * b) * a
    gx, gy, gz = f1 - f0, (f01 - f00) * (1 - a) + (f11 - f10) * a, front - back
    value = f0 * (1 - a) + f1 * a
    if cu != u or cv != v or cw != w:
        return (
            value,
            0.0 if cu != u else gx / voxel,
            0.0 if cv != v else gy / voxel,
            0.0 if cw != w else gz / voxel,
        )
    return value, gx / voxel, gy / voxel, gz / voxel


@njit(cache=True, nogil=True)
@no_type_check
def distances(solids: Solids, points: np.ndarray) -> np.ndarray:
    """Signed distances (n,) [m] of points (n, 3) to the nearest solid."""
    out = np.empty(len(points))
    for p in range(len(points)):
        x, y, z = points[p]
        nearest = grid_sample(solids, x, y, z)[0]
        for i in range(len(solids.table)):
            d = solid_distance(solids.table, i, x, y, z)
            if not d >= nearest:
                nearest = d
        out[p] = nearest
    return out


@njit(cache=True, nogil=True)
@no_type_check
def distances_and_gradients(
    solids: Solids, points: np.ndarray, within: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (n,) [m] and unit gradients (n, 3) at points (n, 3).

    Distances above within[p % len(within)] are cut off there, with a zero gradient, which saves most of the work.
    """
    out = np.empty(len(points))
    gradients = np.empty((len(points), 3))
    close = np.empty(len(solids.table), np.int64)
    for first in range(0, len(points), GROUP):
        last = min(first + GROUP, len(points))
        count = _close_to_group(solids.table, points, within, first, last, close)
        for p in range(first, last):
            x, y, z = points[p]
            nearest, gx, gy, gz, winner = within[p % len(within)], 0.0, 0.0, 0.0, -1
            if len(solids.grid) > 0:
                d, ux, uy, uz = grid_sample(solids, x, y, z)
                if not d >= nearest:
                    nearest, gx, gy, gz = d, ux, uy, uz
            for c in range(count):
                i = close[c]
                if not beyond(solids.table, i, x, y, z, max(nearest, 0.0)):
                    d = solid_distance(solids.table, i, x, y, z)
                    if not d >= nearest:
                        nearest, winner = d, i
            if winner >= 0:
                gx, gy, gz = solid_gradient(solids.table, winner, x, y, z)
            out[p] = nearest
            gradients[p, 0], gradients[p, 1], gradients[p, 2] = gx, gy, gz
    return out, gradients


@njit(cache=True, nogil=True)
@no_type_check
def _close_to_group(
    table: np.ndarray, points: np.ndarray, within: np.ndarray, first: int, last: int, close: np.ndarray
) -> int:
    """Write the solids that may be nearer than `within` to any of the points first to last; returns how many.

    Neighbours in a list of spheres are mostly neighbours in space, so that one ball round them spares most tests.
    """
    x, y, z = points[first]
    spread, reach = 0.0, 0.0
    for p in range(first, last):
        dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
        d = dx * dx + dy * dy + dz * dz
        spread = d if d > spread else (spread if d <= spread else np.inf)  # a NaN must meet all solids
        reach = max(reach, within[p % len(within)])
    spread = math.sqrt(spread)
    count = 0
    for i in range(len(table)):
        if not beyond(table, i, x, y, z, reach + spread):
            close[count] = i
            count += 1
    return count


@njit(cache=True, nogil=True)
@no_type_check
def solid_is_floor(
    table: np.ndarray, i: int, d: float, x: float, y: float, z: float, tolerance: float
) -> bool:
    """Whether solid i at distance d of a point is the floor z = 0: as far off as that, and straight below."""
    return abs(d - z) <= tolerance and solid_gradient(table, i, x, y, z)[2] > FLOOR_SLOPE
