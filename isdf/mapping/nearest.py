"""Nearest surface points of all nodes of a lattice, by sweeping candidates from neighbour to neighbour.

A vector distance transform (Danielsson, 1980) whose vectors end at the surface points themselves, not at lattice
nodes: distances are exact wherever the candidate is, and the candidate is the nearest point or one hardly farther.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

# Where a node's point is that has none.
FAR = np.float32(1e16)


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
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        i0, i1 = min(max(i, 0), nx - 1), min(max(i + 1, 0), nx - 1)
        j0, j1 = min(max(j, 0), ny - 1), min(max(j + 1, 0), ny - 1)
        k0, k1 = min(max(k, 0), nz - 1), min(max(k + 1, 0), nz - 1)
        for a in range(i0, i1 + 1):
            xx = (x - np.float32(a)) * (x - np.float32(a))
            for b in range(j0, j1 + 1):
                xy = xx + (y - np.float32(b)) * (y - np.float32(b))
                for c in range(k0, k1 + 1):
                    d = xy + (z - np.float32(c)) * (z - np.float32(c))
                    if d < square[a + 1, b + 1, c + 1]:
                        square[a + 1, b + 1, c + 1] = d
                        best[a + 1, b + 1, c + 1] = n


@njit(cache=True, nogil=True)
@no_type_check
def _sweep(points, best, square, where):
    """A forward and a backward raster pass: each node tries the points of the neighbours that were passed before it.

    That leaves next to no node with a wrong point. Of the 26 neighbours 13 come before: 12 in other rows, which a whole
    row tries at once, and the last node of its own.
    """
    nx, ny, nz = where.shape
    asked = _asked(where)
    least, source = np.empty(nz + 2, dtype=np.float32), np.empty(nz + 2, dtype=np.int32)
    for direction in (1, -1):
        # The points that the nodes of the last layer and of this one have, with a rim that has none.
        last, this = np.full((ny + 2, 3, nz + 2), FAR), np.full((ny + 2, 3, nz + 2), FAR)
        for a in range(nx):
            i = a + 1 if direction > 0 else nx - a
            for b in range(ny):
                j = b + 1 if direction > 0 else ny - b
                begin, end = asked[i, j, 0], asked[i, j, 1]
                if begin < end:
                    _try_rows(last, this, square, i, j, begin, end, direction, least, source)
                    _settle(points, best, square, where, i, j, begin, end, direction, least, source)
                _note(points, best[i, j], asked[i, j, 2], asked[i, j, 3], this[j])
            last, this = this, last


@njit(cache=True, nogil=True)
@no_type_check
def _asked(where):
    """Of each row, with a rim of rows: begin and end of its nodes that are asked for, and of those beside any such."""
    nx, ny, nz = where.shape
    out = np.zeros((nx + 2, ny + 2, 4), dtype=np.int64)
    out[:, :, 0::2] = nz + 2
    for i in range(1, nx + 1):
        for j in range(1, ny + 1):
            row = where[i - 1, j - 1]
            begin, end = 0, nz
            while begin < nz and not row[begin]:
                begin += 1
            while end > begin and not row[end - 1]:
                end -= 1
            if begin == end:
                continue
            out[i, j, 0], out[i, j, 1] = begin + 1, end + 1
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    out[a, b, 2] = min(out[a, b, 2], max(1, begin))
                    out[a, b, 3] = max(out[a, b, 3], min(nz + 1, end + 2))
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _try_rows(last, this, square, i, j, begin, end, direction, least, source):
    """Write the least squared distance of each node of a row by the points of neighbours in other rows, and of which.

    Made to be vectorised: `source` is the number of the neighbour, in the order in which they come, or -1.
    """
    x, y, z = np.float32(i - 1), np.float32(j - 1), np.int32(begin - 1)
    count, mine = end - begin, square[i, j, begin:end]
    best, which = least[begin:end], source[begin:end]
    for n in range(count):
        best[n], which[n] = mine[n], -1
    for m in range(12):
        row = last[j + direction * (m // 3 - 1)] if m < 9 else this[j - direction]
        shift = begin + direction * (m % 3 - 1)
        to = shift + count
        xs, ys, zs = row[0, shift:to], row[1, shift:to], row[2, shift:to]
        for n in range(count):
            a, b, c = xs[n] - x, ys[n] - y, zs[n] - np.float32(z + np.int32(n))
            d = a * a + b * b + c * c
            nearer = d < best[n]
            best[n] = d if nearer else best[n]
            which[n] = np.int32(m) if nearer else which[n]


@njit(cache=True, nogil=True)
@no_type_check
def _settle(points, best, square, where, i, j, begin, end, direction, least, source):
    """Give the nodes of a row what `_try_rows` found, or the point of the node before them in the row."""
    row, x, y = best[i, j], np.float32(i - 1), np.float32(j - 1)
    for a in range(end - begin):
        k = begin + a if direction > 0 else end - 1 - a
        # All points nearer than a node were offered to it when they entered.
        if not where[i - 1, j - 1, k - 1] or square[i, j, k] <= 1:
            continue
        m, d, mine = source[k], least[k], row[k]
        if m >= 0:
            other = best[i - direction, j + direction * (m // 3 - 1)] if m < 9 else best[i, j - direction]
            mine = other[k + direction * (m % 3 - 1)]
        n = row[k - direction]
        if n >= 0 and n != mine:
            u, v, w = points[n, 0] - x, points[n, 1] - y, points[n, 2] - np.float32(k - 1)
            e = u * u + v * v + w * w
            if e < d:
                d, mine = e, n
        row[k], square[i, j, k] = mine, d


@njit(cache=True, nogil=True)
@no_type_check
def _note(points, best, begin, end, out):
    """Write the points (3, nz + 2) that some nodes of a row have."""
    for k in range(begin, end):
        n = best[k]
        for axis in range(3):
            out[axis, k] = points[n, axis] if n >= 0 else FAR
