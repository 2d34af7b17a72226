"""Backs of boards that nobody saw: a board is as thick all over as where one sees past it.

What is seen from one side only, as a table is from above, would be solid as far behind as distances are fused. Near its
rim, though, space close behind it is looked through from aside, and that tells how thick the board can be.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from .bricks import Bricks, row_of
from .evidence import FREE_ABOVE
from .lattice import CHUNK, LatticeArrays, node_at
from .planes import planes
from .seeds import ENDED

# Free space is looked for so far behind a seed [voxels].
DEEPEST = 5
# A seed tells something if there is surface so far to each of its sides [voxels], off its plane by less than that
# [voxels]: beside the rim it is free anyway. And if its normal is its plane's, within this cosine.
INSIDE, OFF, UPRIGHT = 1.5, 1.5, 0.97
# Behind a plane there is free space if so many of those seeds say so, and so large a share of them.
ENOUGH, SHARE = 6, 0.1
# The back is this much nearer [voxels] than where free space begins behind the first so large share of them: voxels are
# known to be free from their middles, and those closest behind the board are averaged with views that ended on it.
BEFORE, FIRST = 0.85, 0.1
# No board is thinner than this [voxels].
THINNEST = 0.25
# Up to this depth [voxels] views end on the front itself.
FRONT = 1.6
# Depths are counted by this share of a voxel.
BINS = 8


def unseen_backs(
    seeds: Float[np.ndarray, "n 8"], bricks: Bricks, lattice: LatticeArrays
) -> Float[np.ndarray, "m 8"]:
    """Discs that stand for the unseen backs of boards, of weight 0, for they are guesses.

    Args:
        seeds: the surface, see `isdf.mapping.seeds.surface_seeds`.
        bricks: where they were found.
        lattice: its evidence is read.

    Returns:
        float32 (m, 8), of the same kind as the seeds.
    """
    if len(seeds) == 0:
        return seeds
    plane, normal = planes(seeds, bricks.voxel)
    thickness = _thicknesses(seeds, plane, normal, _free_behind(seeds, bricks, lattice), bricks.voxel)
    return _discs(seeds, thickness[plane], bricks)


@njit(cache=True, nogil=True)
@no_type_check
def _free_behind(seeds, bricks, lattice):
    """Depth (n,) float32 [m] at which free space begins behind each seed, inf where none is known, -1 at a rim."""
    out, v = np.full(len(seeds), np.float32(-1)), bricks.voxel
    for s in range(len(seeds)):
        x, y, z, a, b, c = seeds[s, 0], seeds[s, 1], seeds[s, 2], seeds[s, 3], seeds[s, 4], seeds[s, 5]
        if not _inside(bricks, x, y, z, a, b, c):
            continue
        out[s] = np.inf
        for step in range(2, 2 * DEEPEST + 1):
            depth = np.float32(0.5 * step * v)
            i, j, k = _voxel_of(x - depth * a, y - depth * b, z - depth * c, v)
            row, at = row_of(bricks, i, j, k)
            if row >= 0 and bricks.weight[row, at] > 0 and bricks.distance[row, at] > 0:
                # What has come into free space hides what was seen there, and only the coarse evidence knows that.
                beyond = np.float32(depth + 0.5 * lattice.spacing)
                if _looked_through(lattice, x - beyond * a, y - beyond * b, z - beyond * c):
                    out[s] = (x - v * i) * a + (y - v * j) * b + (z - v * k) * c
                break
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _inside(bricks, x, y, z, a, b, c):
    """Whether the surface goes on in four directions along it from a seed at x, y, z with the normal a, b, c."""
    v, reach = bricks.voxel, INSIDE * bricks.voxel
    length = np.sqrt(b * b + c * c) if abs(a) < 0.6 else np.sqrt(a * a + c * c)
    u = (0.0, c / length, -b / length) if abs(a) < 0.6 else (-c / length, 0.0, a / length)
    w = (b * u[2] - c * u[1], c * u[0] - a * u[2], a * u[1] - b * u[0])
    for way in range(4):
        t = u if way < 2 else w
        far = reach if way % 2 else -reach
        i, j, k = _voxel_of(x + far * t[0], y + far * t[1], z + far * t[2], v)
        row, at = row_of(bricks, i, j, k)
        if row < 0 or bricks.weight[row, at] <= 0:
            return False
        height = (v * i - x) * a + (v * j - y) * b + (v * k - z) * c
        if abs(bricks.distance[row, at] - height) >= OFF * v:
            return False
    return True


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _looked_through(lattice, x, y, z):
    """Whether the closest coarse node to a position [m] is known to be free."""
    i, j, k = (
        int(np.floor((x - lattice.origin[0]) / lattice.spacing + 0.5)),
        int(np.floor((y - lattice.origin[1]) / lattice.spacing + 0.5)),
        int(np.floor((z - lattice.origin[2]) / lattice.spacing + 0.5)),
    )
    nx, ny, nz = (
        CHUNK * lattice.table.shape[0],
        CHUNK * lattice.table.shape[1],
        CHUNK * lattice.table.shape[2],
    )
    inside = 0 <= i < nx and 0 <= j < ny and 0 <= k < nz
    return inside and node_at(lattice.table, lattice.evidence, i, j, k, np.uint8(0)) > FREE_ABOVE


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _voxel_of(x, y, z, voxel):
    """Lattice index of the closest voxel to a position [m]."""
    return int(np.floor(x / voxel + 0.5)), int(np.floor(y / voxel + 0.5)), int(np.floor(z / voxel + 0.5))


@njit(cache=True, nogil=True)
@no_type_check
def _thicknesses(seeds, plane, normal, depth, voxel):
    """Thickness (m,) float32 [m] of what has each plane on its front, 0 where it is not known.

    Args:
        seeds: (n, 8).
        plane: (n,) of each seed.
        normal: (m, 3) of each plane.
        depth: (n,) of `_free_behind`.
        voxel: [m].
    """
    inside, counts = np.zeros(len(normal), dtype=np.int64), np.zeros((len(normal), BINS * (DEEPEST + 1)))
    for s in range(len(seeds)):
        p = plane[s]
        along = normal[p, 0] * seeds[s, 3] + normal[p, 1] * seeds[s, 4] + normal[p, 2] * seeds[s, 5]
        if depth[s] >= 0 and along > UPRIGHT:
            inside[p] += 1
            if depth[s] < np.inf:
                counts[p, min(counts.shape[1] - 1, int(BINS * depth[s] / voxel))] += 1
    out = np.zeros(len(normal), dtype=np.float32)
    for p in range(len(normal)):
        total = counts[p].sum()
        if total >= ENOUGH and total >= SHARE * inside[p]:
            passed, bin = counts[p, 0], 0
            while passed < FIRST * total:
                bin += 1
                passed += counts[p, bin]
            out[p] = voxel * max(THINNEST, (bin + 0.5) / BINS - BEFORE)
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _discs(seeds, thickness, bricks):
    """Discs (m, 8) so far behind the seeds (n, 8) as they are thick (n,), if they are and no view ended there."""
    out, count = np.empty((len(seeds), 8), dtype=np.float32), 0
    for s in range(len(seeds)):
        if thickness[s] > 0 and not _ended_behind(bricks, seeds[s], thickness[s]):
            for a in range(3):
                out[count, a] = seeds[s, a] - thickness[s] * seeds[s, 3 + a]
                out[count, 3 + a] = -seeds[s, 3 + a]
            out[count, 6], out[count, 7] = 0, seeds[s, 7]
            count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
@no_type_check
def _ended_behind(bricks, seed, depth):
    """Whether views ended within a voxel of a place behind a seed, at this depth [m]: then its back was seen."""
    for step in range(-2, 3):
        t = depth + 0.5 * step * bricks.voxel
        if t < FRONT * bricks.voxel:
            continue
        i, j, k = _voxel_of(seed[0] - t * seed[3], seed[1] - t * seed[4], seed[2] - t * seed[5], bricks.voxel)
        row, at = row_of(bricks, i, j, k)
        if row >= 0 and bricks.ended[row, at] >= ENDED:
            return True
    return False
