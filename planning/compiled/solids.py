"""Signed distances to boxes, cylinders, balls and a voxel grid, with their gradients, one point at a time."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from planning.compiled.arrays import Solids

FAR = 1e9


@njit(cache=True)
def solid_distance(solids: Solids, i: int, x: float, y: float, z: float) -> float:
    """Signed distance [m] of a point to solid i."""
    turn, centre, size = solids.turn[i], solids.centre[i], solids.size[i]
    dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
    kind = solids.kind[i]
    if kind == 2:
        return math.sqrt(dx * dx + dy * dy + dz * dz) - size[0]
    a = turn[0, 0] * dx + turn[0, 1] * dy + turn[0, 2] * dz
    b = turn[1, 0] * dx + turn[1, 1] * dy + turn[1, 2] * dz
    c = turn[2, 0] * dx + turn[2, 1] * dy + turn[2, 2] * dz
    if kind == 1:
        a = math.sqrt(a * a + b * b) - size[0]
        c = abs(c) - size[1]
        inside = min(max(a, c), 0.0)
        a, c = max(a, 0.0), max(c, 0.0)
        return math.sqrt(a * a + c * c) + inside
    a, b, c = abs(a) - size[0], abs(b) - size[1], abs(c) - size[2]
    inside = min(max(a, b, c), 0.0)
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return math.sqrt(a * a + b * b + c * c) + inside


@njit(cache=True)
def solid_gradient(solids: Solids, i: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit gradient of `solid_distance`; a fixed direction where there are several."""
    turn, centre, size = solids.turn[i], solids.centre[i], solids.size[i]
    dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
    kind = solids.kind[i]
    if kind == 2:
        norm = math.sqrt(dx * dx + dy * dy + dz * dz)
        return (dx / norm, dy / norm, dz / norm) if norm > 0.0 else (1.0, 0.0, 0.0)
    a = turn[0, 0] * dx + turn[0, 1] * dy + turn[0, 2] * dz
    b = turn[1, 0] * dx + turn[1, 1] * dy + turn[1, 2] * dz
    c = turn[2, 0] * dx + turn[2, 1] * dy + turn[2, 2] * dz
    sign_a, sign_b, sign_c = math.copysign(1.0, a), math.copysign(1.0, b), math.copysign(1.0, c)
    if kind == 1:
        radial = math.sqrt(a * a + b * b)
        u, v = (a / radial, b / radial) if radial > 0.0 else (1.0, 0.0)
        r, h = radial - size[0], abs(c) - size[1]
        if r > 0.0 and h > 0.0:
            norm = math.sqrt(r * r + h * h)
            ga, gb, gc = u * r / norm, v * r / norm, sign_c * h / norm
        elif r >= h:
            ga, gb, gc = u, v, 0.0
        else:
            ga, gb, gc = 0.0, 0.0, sign_c
    else:
        a, b, c = abs(a) - size[0], abs(b) - size[1], abs(c) - size[2]
        pa, pb, pc = max(a, 0.0), max(b, 0.0), max(c, 0.0)
        norm = math.sqrt(pa * pa + pb * pb + pc * pc)
        if norm > 0.0:
            ga, gb, gc = sign_a * pa / norm, sign_b * pb / norm, sign_c * pc / norm
        elif a >= b and a >= c:
            ga, gb, gc = sign_a, 0.0, 0.0
        elif b >= c:
            ga, gb, gc = 0.0, sign_b, 0.0
        else:
            ga, gb, gc = 0.0, 0.0, sign_c
    return (
        turn[0, 0] * ga + turn[1, 0] * gb + turn[2, 0] * gc,
        turn[0, 1] * ga + turn[1, 1] * gb + turn[2, 1] * gc,
        turn[0, 2] * ga + turn[1, 2] * gb + turn[2, 2] * gc,
    )


@njit(cache=True)
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
        return value, 0.0 if cu != u else gx / voxel, 0.0 if cv != v else gy / voxel, 0.0 if cw != w else gz / voxel
    return value, gx / voxel, gy / voxel, gz / voxel


@njit(cache=True)
def distances(solids: Solids, points: np.ndarray) -> np.ndarray:
    """Signed distances (n,) [m] of points (n, 3) to the nearest solid."""
    out = np.empty(len(points))
    for p in range(len(points)):
        x, y, z = points[p]
        nearest = grid_sample(solids, x, y, z)[0]
        for i in range(len(solids.kind)):
            d = solid_distance(solids, i, x, y, z)
            if not d >= nearest:
                nearest = d
        out[p] = nearest
    return out


@njit(cache=True)
def distances_and_gradients(solids: Solids, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (n,) [m] and unit gradients (n, 3) at points (n, 3)."""
    out = np.empty(len(points))
    gradients = np.empty((len(points), 3))
    for p in range(len(points)):
        x, y, z = points[p]
        nearest, gx, gy, gz = grid_sample(solids, x, y, z)
        winner = -1
        for i in range(len(solids.kind)):
            d = solid_distance(solids, i, x, y, z)
            if not d >= nearest:
                nearest, winner = d, i
        if winner >= 0:
            gx, gy, gz = solid_gradient(solids, winner, x, y, z)
        out[p] = nearest
        gradients[p, 0], gradients[p, 1], gradients[p, 2] = gx, gy, gz
    return out, gradients


@njit(cache=True)
def is_floor(solids: Solids, i: int, d: float, x: float, y: float, z: float, tolerance: float) -> bool:
    """Whether what is at distance d of a point is the floor z = 0: as far as that, and straight below.

    Solid i, or the grid for i = -1.
    """
    if abs(d - z) > tolerance:
        return False
    upwards = grid_sample(solids, x, y, z)[3] if i < 0 else solid_gradient(solids, i, x, y, z)[2]
    return upwards > 0.5
