"""Nearest surface points of all nodes of a lattice, by sweeping candidates from neighbour to neighbour.

A vector distance transform (Danielsson, 1980) whose vectors end at the surface points themselves, not at lattice
nodes: distances are exact wherever the candidate is, and the candidate is the nearest point or one hardly farther.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def nearest_points(
    points: Float[np.ndarray, "n 3"], where: Bool[np.ndarray, "nx ny nz"]
) -> tuple[Int[np.ndarray, "nx ny nz"], Float[np.ndarray, "nx ny nz"]]:
    """Index of the nearest point of every node and its squared distance.

    Args:
        points: float32 positions in units of nodes: node (i, j, k) lies at (i, j, k).
        where: nodes that are asked for. Candidates pass through no others.

    Returns:
        (nx, ny, nz) int32, -1 everywhere if there is no point; and float32 squared distances [nodes^2].
    """
    best, square = _nothing(where.shape)
    _enter(points, best, square)
    _sweep(points, best, square, where)
    return best[1:-1, 1:-1, 1:-1].copy(), square[1:-1, 1:-1, 1:-1].copy()


@njit(cache=True, nogil=True)
@no_type_check
def finer_nearest(
    points: Float[np.ndarray, "n 3"], coarse: Int[np.ndarray, "mx my mz"], where: Bool[np.ndarray, "nx ny nz"]
) -> Int[np.ndarray, "nx ny nz"]:
    """Index of the nearest point of every node of a lattice of half the spacing of one where they are known.

    Args:
        points: float32 positions in units of the finer nodes.
        coarse: nearest points of the coarser nodes: (i, j, k) lies at the finer node (2 i, 2 j, 2 k).
        where: finer nodes that are asked for besides the coarser ones, n = 2 m - 1 an axis.
    """
    best, square = _nothing(where.shape)
    _enter(points, best, square)
    nx, ny, nz = coarse.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                _offer(points, coarse[i, j, k], 2 * i, 2 * j, 2 * k, best, square)
    _sweep(points, best, square, where)
    return best[1:-1, 1:-1, 1:-1].copy()


@njit(cache=True, nogil=True)
@no_type_check
def _nothing(shape):
    """Points and squared distances of nodes that know no point yet, with a rim of such nodes about them."""
    padded = (shape[0] + 2, shape[1] + 2, shape[2] + 2)
    return np.full(padded, -1, dtype=np.int32), np.full(padded, np.float32(1e30), dtype=np.float32)


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _offer(points, n, i, j, k, best, square):
    """Let node (i, j, k) have point n if it is nearer than what the node has."""
    x, y, z = points[n, 0] - np.float32(i), points[n, 1] - np.float32(j), points[n, 2] - np.float32(k)
    d = x * x + y * y + z * z
    if d < square[i + 1, j + 1, k + 1]:
        square[i + 1, j + 1, k + 1] = d
        best[i + 1, j + 1, k + 1] = n


@njit(cache=True, nogil=True)
@no_type_check
def _enter(points, best, square):
    """Offer every point to the nodes about it; points outside enter at the closest nodes of the rim."""
    nx, ny, nz = best.shape[0] - 2, best.shape[1] - 2, best.shape[2] - 2
    for n in range(points.shape[0]):
        i, j, k = int(np.floor(points[n, 0])), int(np.floor(points[n, 1])), int(np.floor(points[n, 2]))
        i0, i1 = min(max(i, 0), nx - 1), min(max(i + 1, 0), nx - 1)
        j0, j1 = min(max(j, 0), ny - 1), min(max(j + 1, 0), ny - 1)
        k0, k1 = min(max(k, 0), nz - 1), min(max(k + 1, 0), nz - 1)
        for a in range(i0, i1 + 1):
            for b in range(j0, j1 + 1):
                for c in range(k0, k1 + 1):
                    _offer(points, n, a, b, c, best, square)


@njit(cache=True, nogil=True)
@no_type_check
def _sweep(points, best, square, where):
    """A forward and a backward raster pass: each node tries the points of the neighbours that were passed before it.

    That leaves next to no node with a wrong point.
    """
    nx, ny, nz = where.shape
    near, least = best.reshape(-1), square.reshape(-1)
    row, layer = nz + 2, (ny + 2) * (nz + 2)
    # Of the 26 neighbours those that come before: (-1, *, *), (0, -1, *) and (0, 0, -1).
    offsets = np.array(
        [-layer + a * row + b for a in (-1, 0, 1) for b in (-1, 0, 1)] + [-row - 1, -row, -row + 1, -1]
    )
    for direction in (1, -1):
        for a in range(nx):
            i = a if direction > 0 else nx - 1 - a
            for b in range(ny):
                j = b if direction > 0 else ny - 1 - b
                for c in range(nz):
                    k = c if direction > 0 else nz - 1 - c
                    if not where[i, j, k]:
                        continue
                    at = (i + 1) * layer + (j + 1) * row + k + 1
                    mine, d = near[at], least[at]
                    if d <= 1:  # all points that near were offered to it when they entered
                        continue
                    tried = mine
                    for m in range(13):
                        n = near[at + direction * offsets[m]]
                        if n in (tried, mine) or n < 0:
                            continue
                        tried = n
                        x, y, z = (
                            points[n, 0] - np.float32(i),
                            points[n, 1] - np.float32(j),
                            points[n, 2] - np.float32(k),
                        )
                        e = x * x + y * y + z * z
                        if e < d:
                            d, mine = e, n
                    near[at], least[at] = mine, d
