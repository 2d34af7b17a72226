"""Surfaces continued beyond where they were cut off: by the edge of an image, or by something in front.

Most surfaces go on flat. So for every node the plane of the closest seen surface is laid out to the node's foot on it,
and what is known of two places is told: beside the point where what was seen of the surface ends, and at the foot. Free
space behind the plane there proves that the surface does not reach so far; unknown space leaves it open.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

# Of `continued`: off the plane, along it, share of the gap, and free space behind and before it at two places.
PLANES = 7
# So far [nodes] beside the end of what was seen, and so far behind and before the plane, is asked what is free.
ASIDE, BEHIND = 0.75, 0.75
# Nodes whose bounds are closer than this [nodes], or that are farther than this from any surface, are not asked for.
LEAST_GAP, REACH = 0.1, 18.75


@njit(cache=True, nogil=True)
@no_type_check
def continued(
    seeds: Float[np.ndarray, "n 6"],
    nearest: Int[np.ndarray, "nx ny nz"],
    upper: Float[np.ndarray, "nx ny nz"],
    lower: Float[np.ndarray, "nx ny nz"],
    free: Bool[np.ndarray, "nx ny nz"],
) -> Float[np.ndarray, "7 nx ny nz"]:
    """What the plane of the closest surface says of every node; 0 where the bounds leave nothing to guess.

    Args:
        seeds: float32 surface points in units of nodes, and their unit normals towards where they were seen from.
        nearest: index of each node's closest seed.
        upper: distance to it [nodes].
        lower: the lower bound [nodes].
        free: looked through.

    Returns:
        float32: signed distance from the plane and distance along it from the seed to the foot [nodes]; where between
        the bounds the plane lies (0 at the upper, 1 at the lower); then how free it is, from 0 to 1, behind the plane
        and before it beside the seed, and behind and before it at the foot.
    """
    nx, ny, nz = free.shape
    out = np.zeros((PLANES, nx, ny, nz), dtype=np.float32)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                gap = upper[i, j, k] - lower[i, j, k]
                if gap < LEAST_GAP or upper[i, j, k] > REACH:
                    continue
                s = seeds[nearest[i, j, k]]
                a, b, c = i - s[0], j - s[1], k - s[2]
                off = a * s[3] + b * s[4] + c * s[5]
                # Along the plane, from the seed to the foot.
                a, b, c = a - off * s[3], b - off * s[4], c - off * s[5]
                along = np.sqrt(a * a + b * b + c * c)
                # Free space is not inside of anything.
                plane = abs(off) if free[i, j, k] else off
                out[0, i, j, k], out[1, i, j, k] = off, along
                out[2, i, j, k] = min(max((upper[i, j, k] - plane) / gap, 0.0), 1.0)
                step = ASIDE / max(along, ASIDE)
                for n, share in enumerate((step, 1.0)):
                    for m, deep in enumerate((-BEHIND, BEHIND)):
                        x = s[0] + share * a + deep * s[3]
                        y = s[1] + share * b + deep * s[4]
                        z = s[2] + share * c + deep * s[5]
                        out[3 + 2 * n + m, i, j, k] = _freedom(free, x, y, z)
    return out


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _freedom(free, x, y, z):
    """How free it is at a place [nodes], between the eight nodes about it; 0 outside of the window."""
    nx, ny, nz = free.shape
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    if i < 0 or j < 0 or k < 0 or i >= nx - 1 or j >= ny - 1 or k >= nz - 1:
        return 0.0
    a, b, c, total = x - i, y - j, z - k, 0.0
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                if free[i + di, j + dj, k + dk]:
                    total += (a if di else 1 - a) * (b if dj else 1 - b) * (c if dk else 1 - c)
    return total
