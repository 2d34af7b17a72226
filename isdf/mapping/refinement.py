"""Cells of a window in which straight lines between the coarse nodes do not do, and what they miss there."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from .bricks import Bricks
from .evidence import FREE_ABOVE
from .lattice import BLOCK, FINE, STEP
from .patches import MOST, NODES, Patches, cell_place, height_above, nearest_of, patch_at, patches_about
from .values import SOLID, Window, fused_at, side_of

# A cell is refined when interpolation misses one of its middles by more than this [m], plus shares of the distance
# and of what is guessed there.
TOLERANCE, SLACK, GUESS_SLACK = 0.003, 0.004, 0.05
# Weights (8, 125) of a cell's corners in trilinear interpolation at its fine nodes.
_part = np.stack([np.linspace(1, 0, FINE), np.linspace(0, 1, FINE)])
WEIGHTS = np.einsum("pa,qb,rc->pqrabc", _part, _part, _part).reshape(8, BLOCK).astype(np.float32)


@njit(cache=True, nogil=True)
@no_type_check
def near_known(window: Window, bricks: Bricks):
    """Which nodes of half the spacing belong to a cell with a corner that was looked through, fused or near a surface.

    Args:
        window: its evidence and upper bounds are read.
        bricks: the truncated distances.

    Returns:
        (2 nx - 1, 2 ny - 1, 2 nz - 1) bool. Only there can a cell be refined.
    """
    nx, ny, nz = window.evidence.shape
    out = np.zeros((2 * nx - 1, 2 * ny - 1, 2 * nz - 1), dtype=np.bool_)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                at = (i * window.ratio, j * window.ratio, k * window.ratio)
                # Patches reach out from their seeds by less than a step.
                near = window.upper[i, j, k] < SOLID + window.step
                if near or window.evidence[i, j, k] > FREE_ABOVE or fused_at(window, bricks, at)[1] > 0:
                    out[
                        max(0, 2 * i - 2) : 2 * i + 3,
                        max(0, 2 * j - 2) : 2 * j + 3,
                        max(0, 2 * k - 2) : 2 * k + 3,
                    ] = True
    return out


@njit(cache=True, nogil=True)
@no_type_check
def middle_values(window: Window, patches: Patches, bricks: Bricks, where):
    """What trilinear interpolation says in the middles of edges, of faces and of cells, and by how much it misses.

    Args:
        window: with its coarse values.
        patches: the surface.
        bricks: the truncated distances.
        where: of `near_known`.

    Returns:
        line and miss [m], float32 of the shape of `where`, 0 outside it; nothing is missed at the coarse nodes.
    """
    line, miss = np.zeros(where.shape, dtype=np.float32), np.zeros(where.shape, dtype=np.float32)
    step = window.ratio // 2
    for i in range(where.shape[0]):
        for j in range(where.shape[1]):
            for k in range(where.shape[2]):
                if not where[i, j, k]:
                    continue
                if (i | j | k) & 1 == 0:
                    line[i, j, k] = window.value[i // 2, j // 2, k // 2]
                    continue
                value, seen, free, taken_free, taken_other = _mean_of_corners(window, i, j, k)
                upper, height, weight = patch_at(window, patches, (i, j, k))
                at = (i * step, j * step, k * step)
                sign = side_of(window, bricks, at, upper, height, weight, seen)
                line[i, j, k] = value
                miss[i, j, k] = _fine_value(upper, sign, seen, free, taken_free, taken_other) - value
    return line, miss


@njit(cache=True, nogil=True)
@no_type_check
def cells_to_refine(window: Window, line, miss, corrections, refine, stale):
    """Find the cells in which trilinear interpolation misses the middle of an edge, of a face or of the cell.

    Args:
        window: with its coarse values.
        line: of `middle_values` [m].
        miss: of `middle_values` [m].
        corrections: (n, 125) of all refined cells.
        refine: of the window's shape, written: the cell above the node is to be refined.
        stale: of the window's shape, written: what is stored of it misses one of its middles, too.
    """
    shape, step = window.value.shape, window.ratio // 2
    for i in range(shape[0] - 1):
        for j in range(shape[1] - 1):
            for k in range(shape[2] - 1):
                refine[i, j, k], stale[i, j, k] = False, False
                most, known = _corners(window, i, j, k)
                number = window.block[i, j, k]
                if not known:
                    continue
                for m in range(27):
                    a, b, c = m // 9, (m // 3) % 3, m % 3
                    at = (2 * i + a, 2 * j + b, 2 * k + c)
                    off = miss[at]
                    slack = TOLERANCE + SLACK * abs(line[at]) + GUESS_SLACK * most
                    refine[i, j, k] |= abs(off) > slack
                    if number >= 0:
                        stored = STEP * corrections[number, step * ((a * FINE + b) * FINE + c)]
                        stale[i, j, k] |= abs(stored - off) > 0.5 * slack
                    if refine[i, j, k] and (number < 0 or stale[i, j, k]):
                        break


@njit(cache=True, nogil=True)
@no_type_check
def refined_values(window: Window, patches: Patches, bricks: Bricks, miss, cells, corrections):
    """Write the corrections of cells (n, 3): what interpolation of the corners misses at each of their fine nodes.

    At every second of them that is known: `miss` of `middle_values` [m].
    """
    between, offsets = np.empty((5, BLOCK), dtype=np.float32), np.float32(window.step) * NODES
    chosen, which = np.empty(MOST, dtype=np.int32), np.zeros(BLOCK, dtype=np.int32)
    distance, discs = np.empty(BLOCK, dtype=np.float32), patches.discs
    for n in range(len(cells)):
        i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
        _between_corners(window, i, j, k, between)
        count, place = patches_about(window, patches, i, j, k, chosen), cell_place(window, i, j, k)
        nearest_of(discs, chosen[:count], place, offsets, distance, which)
        number = window.block[i, j, k]
        for m in range(BLOCK):
            a, b, c = m // FINE**2, (m // FINE) % FINE, m % FINE
            if (a | b | c) & 1 == 0:
                off = miss[2 * i + a // 2, 2 * j + b // 2, 2 * k + c // 2]
            else:
                at = (i * window.ratio + a, j * window.ratio + b, k * window.ratio + c)
                value, seen, free, taken_free, taken_other = between[:, m]
                height, weight = height_above(discs, which[m], place, offsets, m), discs[which[m], 6]
                sign = side_of(window, bricks, at, distance[m], height, weight, seen)
                off = _fine_value(distance[m], sign, seen, free, taken_free, taken_other) - value
            steps = max(np.float32(-127), min(np.float32(127), off / np.float32(STEP)))
            corrections[number, m] = int(np.floor(steps + np.float32(0.5)))


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _fine_value(upper, sign, seen, free, taken_free, taken_other):
    """Distance [m] of a fine node.

    Args:
        upper: distance to the surface [m].
        sign: side of it by the fused distances.
        seen: evidence, interpolated.
        free: weight of the free corners, of 1.
        taken_free: what they take off, times their weight [m].
        taken_other: the same of the other corners [m].
    """
    if sign < 0:
        return -upper
    # Free corners tell what to take off in free space, the others what to take off elsewhere.
    if sign > 0:
        return upper - min(upper, taken_free / free if free > 0 else np.float32(0))
    return upper - min(upper + upper, taken_other / (1 - free) if free < 1 else taken_free)


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _of_corner(window, i, j, k):
    """What is interpolated of a node: value, evidence, free or not, and what a free and another node takes off."""
    value, seen, taken = window.value[i, j, k], np.float32(window.evidence[i, j, k]), window.taken[i, j, k]
    if window.state[i, j, k] > 0:
        return value, seen, np.float32(1), taken, np.float32(0)
    return value, seen, np.float32(0), np.float32(0), taken


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _mean_of_corners(window, i, j, k):
    """Interpolation of all that `_of_corner` gives at a node of half the spacing."""
    value = seen = free = taken_free = taken_other = np.float32(0)
    for a in range(i // 2, (i + 1) // 2 + 1):
        for b in range(j // 2, (j + 1) // 2 + 1):
            for c in range(k // 2, (k + 1) // 2 + 1):
                one = _of_corner(window, a, b, c)
                value += one[0]
                seen += one[1]
                free += one[2]
                taken_free += one[3]
                taken_other += one[4]
    w = np.float32(1 / ((1 + (i & 1)) * (1 + (j & 1)) * (1 + (k & 1))))
    return w * value, w * seen, w * free, w * taken_free, w * taken_other


@njit(cache=True, nogil=True)
@no_type_check
def _between_corners(window, i, j, k, out):
    """Trilinear interpolation of all that `_of_corner` gives at the fine nodes of a cell, written to out (5, 125)."""
    out[:] = 0
    for q in range(8):
        corner = _of_corner(window, i + (q >> 2), j + ((q >> 1) & 1), k + (q & 1))
        for f in range(5):
            if corner[f] != 0:
                for m in range(BLOCK):
                    out[f, m] += WEIGHTS[q, m] * corner[f]


@njit(cache=True, nogil=True)
@no_type_check
def _corners(window, i, j, k):
    """Of a cell: how much is taken off at most [m], and whether the state of any corner is known."""
    most, known = np.float32(0), False
    for p in range(2):
        for q in range(2):
            for r in range(2):
                state = window.state[i + p, j + q, k + r]
                known |= state != 0
                if state >= 0:
                    most = max(most, window.taken[i + p, j + q, k + r])
    return most, known
