"""Nearest surface points of all nodes of a lattice, by sweeping candidates from neighbour to neighbour.

A vector distance transform (Danielsson, 1980) whose vectors end at the surface points themselves, not at lattice
nodes: distances are exact wherever the candidate is, and the candidate is the nearest point or one hardly farther.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def nearest_points(
    points: Float[np.ndarray, "n 3"], shape: tuple[int, int, int], rounds: int
) -> tuple[Int[np.ndarray, "nx ny nz"], Float[np.ndarray, "nx ny nz"]]:
    """Index of the nearest point of every node and its squared distance.

    Args:
        points: float32 positions in units of nodes: node (i, j, k) lies at (i, j, k).
        shape: nodes an axis.
        rounds: forward and backward sweeps; two leave next to no node with a wrong point.

    Returns:
        (nx, ny, nz) int32, -1 everywhere if there is no point; and float32 squared distances [nodes^2].
    """
    nx, ny, nz = shape
    best = np.full(shape, -1, dtype=np.int32)
    square = np.full(shape, np.float32(1e30), dtype=np.float32)
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        # Points outside enter at the closest nodes of the rim.
        i0, i1 = min(max(int(np.floor(x)), 0), nx - 1), min(max(int(np.floor(x)) + 1, 0), nx - 1)
        j0, j1 = min(max(int(np.floor(y)), 0), ny - 1), min(max(int(np.floor(y)) + 1, 0), ny - 1)
        k0, k1 = min(max(int(np.floor(z)), 0), nz - 1), min(max(int(np.floor(z)) + 1, 0), nz - 1)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    d = (x - i) ** 2 + (y - j) ** 2 + (z - k) ** 2
                    if d < square[i, j, k]:
                        square[i, j, k] = d
                        best[i, j, k] = n
    for _ in range(rounds):
        for direction in (1, -1):
            _sweep(points, best, square, direction)
    return best, square


@njit(cache=True, nogil=True)
@no_type_check
def _sweep(points, best, square, direction):
    """One raster pass: each node tries the points of the 13 neighbours that were passed before it."""
    nx, ny, nz = best.shape
    for a in range(nx):
        i = a if direction > 0 else nx - 1 - a
        for b in range(ny):
            j = b if direction > 0 else ny - 1 - b
            for c in range(nz):
                k = c if direction > 0 else nz - 1 - c
                mine, least = best[i, j, k], square[i, j, k]
                tried = mine
                for m in range(13):
                    # Offsets (-1, *, *), (0, -1, *) and (0, 0, -1), seen along the direction of the pass.
                    di = -1 if m < 9 else 0
                    dj = (m // 3 - 1) if m < 9 else (-1 if m < 12 else 0)
                    dk = (m % 3 - 1) if m < 9 else (m - 10 if m < 12 else -1)
                    ii, jj, kk = i + di * direction, j + dj * direction, k + dk * direction
                    if ii < 0 or ii >= nx or jj < 0 or jj >= ny or kk < 0 or kk >= nz:
                        continue
                    n = best[ii, jj, kk]
                    if n in (mine, tried) or n < 0:
                        continue
                    tried = n
                    d = (points[n, 0] - i) ** 2 + (points[n, 1] - j) ** 2 + (points[n, 2] - k) ** 2
                    if d < least:
                        least, mine = d, n
                best[i, j, k], square[i, j, k] = mine, least
