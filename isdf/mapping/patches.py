"""The discs that stand for the surface, and which of them is nearest to the nodes of a window."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from .lattice import BLOCK, FINE

# Fine nodes (3, 125) of a cell, in steps from its first.
NODES = np.stack(np.meshgrid(*[np.arange(FINE)] * 3, indexing="ij")).reshape(3, BLOCK).astype(np.float32)
# At most so many discs are tried for a cell.
MOST = 256


class Patches(NamedTuple):
    """Discs that stand for the surface, and where they are.

    Args:
        discs: (n, 8) float32, see `isdf.mapping.seeds.surface_seeds`; those of `isdf.mapping.backs` have no weight.
        nearest: (nx, ny, nz) int32 index of the disc whose middle is nearest to every second fine node of the window.
        head: (nx, ny, nz) int32 index of a disc in the cube above each of these nodes, -1 if there is none.
        following: (n,) int32 index of the next disc in the same cube, or -1.
    """

    discs: Float[np.ndarray, "n 8"]
    nearest: Int[np.ndarray, "nx ny nz"]
    head: Int[np.ndarray, "nx ny nz"]
    following: Int[np.ndarray, "n"]


@njit(cache=True, nogil=True)
@no_type_check
def in_cubes(places, shape):
    """Lists of the places (n, 3) in each unit cube of an array of this shape: `head` and `following` of `Patches`."""
    head, following = np.full(shape, -1, dtype=np.int32), np.full(len(places), -1, dtype=np.int32)
    for n in range(len(places)):
        i, j, k = int(np.floor(places[n, 0])), int(np.floor(places[n, 1])), int(np.floor(places[n, 2]))
        if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
            following[n], head[i, j, k] = head[i, j, k], n
    return head, following


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def patch_at(window, patches, at):
    """Distance [m] of a fine node to the disc nearest to it, height above it [m], and its weight.

    Args:
        window: where.
        patches: the discs.
        at: the node's index in `patches.nearest`.
    """
    half = np.float32(0.5) * window.ratio * window.step
    discs, n = patches.discs, patches.nearest[at]
    a = np.float32(half * (2 * window.first[0] + at[0]) - discs[n, 0])
    b = np.float32(half * (2 * window.first[1] + at[1]) - discs[n, 1])
    c = np.float32(half * (2 * window.first[2] + at[2]) - discs[n, 2])
    height = a * discs[n, 3] + b * discs[n, 4] + c * discs[n, 5]
    aside = np.sqrt(max(np.float32(0), a * a + b * b + c * c - height * height))
    across = max(np.float32(0), aside - discs[n, 7])
    return np.sqrt(across * across + height * height), height, discs[n, 6]


@njit(cache=True, nogil=True)
@no_type_check
def patches_about(window, patches, i, j, k, out):
    """Write the discs that may be nearest to fine nodes of a cell; returns how many.

    Those nearest to every second of them, and all whose middle is in the cell or less than a step outside: close to a
    surface a node may lie above a disc that is nearest to none of the others.
    """
    nearest, head, following, discs = patches.nearest, patches.head, patches.following, patches.discs
    count = 0
    for a in range(2 * i, 2 * i + 3):
        for b in range(2 * j, 2 * j + 3):
            for c in range(2 * k, 2 * k + 3):
                if not _among(out, count, nearest[a, b, c]):
                    out[count] = nearest[a, b, c]
                    count += 1
    first, step = count, np.float32(window.step)
    place, end = cell_place(window, i, j, k), np.float32(window.step * (window.ratio + 1))
    for a in range(max(0, 2 * i - 1), min(head.shape[0], 2 * i + 3)):
        for b in range(max(0, 2 * j - 1), min(head.shape[1], 2 * j + 3)):
            for c in range(max(0, 2 * k - 1), min(head.shape[2], 2 * k + 3)):
                n = head[a, b, c]
                while n >= 0 and count < len(out):
                    x, y, z = discs[n, 0] - place[0], discs[n, 1] - place[1], discs[n, 2] - place[2]
                    close = min(min(x, y), z) > -step and max(max(x, y), z) < end
                    if close and not _among(out, first, n):
                        out[count] = n
                        count += 1
                    n = following[n]
    return count


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _among(values, count, value):
    found = False
    for m in range(count):
        found |= values[m] == value
    return found


@njit(cache=True, nogil=True)
@no_type_check
def cell_place(window, i, j, k):
    """Position [m] of a coarse node, the first of its cell."""
    spacing = window.step * window.ratio
    return (
        np.float32(spacing * (window.first[0] + i)),
        np.float32(spacing * (window.first[1] + j)),
        np.float32(spacing * (window.first[2] + k)),
    )


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def nearest_of(discs, chosen, place, offsets, distance, which):
    """The nearest of some discs to each of a cell's fine nodes; made to be vectorised.

    Args:
        discs: (n, 8).
        chosen: (m,) the discs to choose from.
        place: of the cell's first node [m].
        offsets: (3, 125) of its fine nodes from there [m].
        distance: (125,) float32, written [m].
        which: (125,) int32, written.
    """
    xs, ys, zs, zero = offsets[0], offsets[1], offsets[2], np.float32(0)
    for m in range(BLOCK):
        distance[m] = np.float32(1e30)
    for c in range(len(chosen)):
        n = chosen[c]
        x, y, z = place[0] - discs[n, 0], place[1] - discs[n, 1], place[2] - discs[n, 2]
        u, v, w, radius = discs[n, 3], discs[n, 4], discs[n, 5], discs[n, 7]
        for m in range(BLOCK):
            a, b, e = x + xs[m], y + ys[m], z + zs[m]
            height = a * u + b * v + e * w
            across = max(zero, np.sqrt(max(zero, a * a + b * b + e * e - height * height)) - radius)
            square = across * across + height * height
            nearer = square < distance[m]
            distance[m] = square if nearer else distance[m]
            which[m] = n if nearer else which[m]
    for m in range(BLOCK):
        distance[m] = np.sqrt(distance[m])


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def height_above(discs, n, place, offsets, m):
    """Height [m] of fine node `m` of a cell above the plane of disc `n`; arguments as for `nearest_of`."""
    return (
        (place[0] + offsets[0, m] - discs[n, 0]) * discs[n, 3]
        + (place[1] + offsets[1, m] - discs[n, 1]) * discs[n, 4]
        + (place[2] + offsets[2, m] - discs[n, 2]) * discs[n, 5]
    )
