"""Which surface seeds lie in one plane: pieces of planes within bricks, joined across the bricks' borders."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from .bricks import SIDE

# Seeds of a brick are of one piece if their normals are this alike (cosine) and they lie so near its plane [voxels].
ALIKE, NEAR = 0.9, 0.75
# The same for the pieces of neighbouring bricks: means are less noisy, but lie farther apart.
ALIKE_NEXT, NEAR_NEXT = 0.95, 1.25


@njit(cache=True, nogil=True)
@no_type_check
def planes(
    seeds: Float[np.ndarray, "n 8"], voxel: float
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "m 3"]]:
    """The plane that each seed lies in, and the mean normal of each plane.

    Args:
        seeds: at least one, see `isdf.mapping.seeds.surface_seeds`.
        voxel: edge of a voxel [m].

    Returns:
        (n,) int64 numbers of planes, and (m, 3) float32 unit normals; zeros where no seed has that number.
    """
    piece, means, place, head, after = _pieces(seeds, voxel)
    plane = np.arange(len(means))
    for p in range(len(means)):
        for i in range(place[p, 0] - 1, place[p, 0] + 2):
            for j in range(place[p, 1] - 1, place[p, 1] + 2):
                for k in range(place[p, 2] - 1, place[p, 2] + 2):
                    q = head[i, j, k]
                    while q >= 0:
                        if q < p and _in_line(means[p], means[q], np.float32(NEAR_NEXT * voxel)):
                            _join(plane, p, q)
                        q = after[q]
    for p in range(len(plane)):
        plane[p] = _root(plane, p)
    number = plane[piece]
    normal = np.zeros((len(means), 3), dtype=np.float32)
    for s in range(len(seeds)):
        normal[number[s]] += seeds[s, 3:6]
    for p in range(len(normal)):
        normal[p] /= max(np.sqrt((normal[p] ** 2).sum()), np.float32(1e-9))
    return number, normal


@njit(cache=True, nogil=True)
@no_type_check
def _pieces(seeds, voxel):
    """Sort the seeds of every brick into pieces of planes.

    Returns:
        piece (n,) of each seed; mean positions and unit normals (m, 6) of the pieces; their bricks (m, 3) as indices of
        a table; the table (nx, ny, nz) of the last piece of each brick, -1 where there is none; and the piece before
        each (m,) in its brick.
    """
    edge, off = np.float32(SIDE * voxel), np.float32(NEAR * voxel)
    lower, shape = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for a in range(3):
        # A rim of empty bricks, so that every brick has neighbours.
        lower[a] = int(np.floor(seeds[:, a].min() / edge)) - 1
        shape[a] = int(np.floor(seeds[:, a].max() / edge)) + 2 - lower[a]
    head = np.full((shape[0], shape[1], shape[2]), -1, dtype=np.int64)
    size = len(seeds)
    piece, after = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.int64)
    first, means = np.empty((size, 4), dtype=np.float32), np.zeros((size, 6), dtype=np.float32)
    place, number, count = np.empty((size, 3), dtype=np.int64), np.zeros(size, dtype=np.int64), 0
    for s in range(size):
        x, y, z, a, b, c = seeds[s, 0], seeds[s, 1], seeds[s, 2], seeds[s, 3], seeds[s, 4], seeds[s, 5]
        i, j, k = int(np.floor(x / edge)), int(np.floor(y / edge)), int(np.floor(z / edge))
        i, j, k = i - lower[0], j - lower[1], k - lower[2]
        p = head[i, j, k]
        while p >= 0:
            n = first[p]
            if a * n[0] + b * n[1] + c * n[2] > ALIKE and abs(x * n[0] + y * n[1] + z * n[2] - n[3]) < off:
                break
            p = after[p]
        if p < 0:
            p = count
            count += 1
            after[p], head[i, j, k] = head[i, j, k], p
            place[p, 0], place[p, 1], place[p, 2] = i, j, k
            first[p, 0], first[p, 1], first[p, 2], first[p, 3] = a, b, c, x * a + y * b + z * c
        piece[s] = p
        number[p] += 1
        for m in range(6):
            means[p, m] += seeds[s, m]
    for p in range(count):
        length = np.sqrt(means[p, 3] ** 2 + means[p, 4] ** 2 + means[p, 5] ** 2)
        means[p, :3] /= number[p]
        means[p, 3:] /= length
    return piece, means[:count], place, head, after


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _in_line(p, q, off):
    """Whether two pieces (6,) have normals alike, and each lies in the other's plane."""
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    return (
        p[3] * q[3] + p[4] * q[4] + p[5] * q[5] > ALIKE_NEXT
        and abs(x * p[3] + y * p[4] + z * p[5]) < off
        and abs(x * q[3] + y * q[4] + z * q[5]) < off
    )


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _join(plane, p, q):
    """Let the planes that two pieces are of be one."""
    a, b = _root(plane, p), _root(plane, q)
    plane[max(a, b)] = min(a, b)


@njit(cache=True, nogil=True)
@no_type_check
def _root(plane, p):
    """The first piece of the plane that a piece is of."""
    while plane[p] != p:
        plane[p] = plane[plane[p]]
        p = plane[p]
    return p
