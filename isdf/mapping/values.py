"""Distances at the nodes of a window: from the nearest seeds, from what was looked through, and from the guesses."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from .bricks import Bricks, voxel_at
from .evidence import FREE_ABOVE, SURFACE_REACH
from .lattice import FINE, STEP

# A cell is refined when interpolation misses one of its middles by more than this [m], plus shares of the distance
# and of what is guessed there.
TOLERANCE, SLACK, GUESS_SLACK = 0.004, 0.01, 0.15
# Errors above this [m] are what the confidence is about.
LARGE_ERROR = 0.05
# Odds that a well-seen seed is wrong by that much, how much greater they are for one hardly seen, and the weight
# (in measurements at 1 m) that makes the difference; read off seeds of a simulated office.
SEED_ODDS, FAINT_ODDS, FAINT_WEIGHT = 0.003, 0.15, 0.1
# In space looked through, a guess that takes off less than this share of its own expected error takes off nothing: the
# network's sigmoid never reaches zero, but there the median mostly is zero.
LEAST_OF_ERROR = 0.5


class Patches(NamedTuple):
    """Discs that stand for the surface, and which is nearest where.

    Args:
        centre: (n, 3) float32 [m].
        normal: (n, 3) float32.
        weight: (n,) float32, evidence of each.
        radius: of all [m].
        nearest: (nx, ny, nz) int32 index of the nearest of every second fine node of the window.
    """

    centre: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    weight: Float[np.ndarray, "n"]
    radius: float
    nearest: Int[np.ndarray, "nx ny nz"]


class Window(NamedTuple):
    """A box of coarse nodes, and views of the lattice's arrays there, all of one shape.

    Args:
        first: (3,) lattice index of its first node.
        ratio: fine steps between coarse nodes.
        evidence: uint8, see `isdf.mapping.evidence`.
        lower: float32, lower bounds [m].
        share: float32, guessed shares of the gap between the bounds.
        width: float32, logarithm of the expected error over the gap.
        value: float32 distances [m].
        confidence: uint8.
        state: int8: 1 in free space, -1 behind a seen surface, 0 where neither is known.
        taken: float32, what is taken off the distance to the nearest patch [m].
        block: int32, number of the cell's corrections or -1.
    """

    first: np.ndarray
    ratio: int
    evidence: np.ndarray
    lower: np.ndarray
    share: np.ndarray
    width: np.ndarray
    value: np.ndarray
    confidence: np.ndarray
    state: np.ndarray
    taken: np.ndarray
    block: np.ndarray


@njit(cache=True, nogil=True)
@no_type_check
def coarse_values(window: Window, patches: Patches, bricks: Bricks) -> None:
    """Write value, confidence, state and what was taken off of every node of a window."""
    shape = window.value.shape
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                at = (i * window.ratio, j * window.ratio, k * window.ratio)
                upper, side, seed = _nearest_patch(window, patches, bricks.voxel, at)
                sign = _sign(window, bricks, at, side)
                if sign == 0 and window.evidence[i, j, k] > FREE_ABOVE:
                    sign = 1
                low = min(window.lower[i, j, k], upper)
                if sign < 0:
                    low = upper
                elif sign > 0:
                    low = max(low, np.float32(0))
                elif upper < SURFACE_REACH * window.ratio * bricks.voxel:
                    low = -upper
                else:
                    low = max(min(low, np.float32(0)), -upper)
                gap = upper - low
                error = gap * np.exp(window.width[i, j, k])
                share = window.share[i, j, k]
                if sign > 0 and share < LEAST_OF_ERROR * np.exp(window.width[i, j, k]):
                    share = np.float32(0)
                window.taken[i, j, k] = 2 * upper if sign < 0 else gap * share
                window.value[i, j, k] = upper - window.taken[i, j, k]
                window.state[i, j, k] = sign
                faint = FAINT_WEIGHT / (patches.weight[seed] + FAINT_WEIGHT)
                odds = SEED_ODDS + FAINT_ODDS * faint
                # The guess's error is Laplace distributed: its chance to be small, times that of the seed.
                chance = (1 - np.exp(-LARGE_ERROR / max(error, np.float32(1e-3)))) / (1 + odds)
                # Nobody has looked there: never more likely right than wrong.
                chance = chance if sign != 0 else 0.5 * chance
                window.confidence[i, j, k] = int(255 * chance + 0.5)


@njit(cache=True, nogil=True)
@no_type_check
def cells_to_refine(window: Window, patches: Patches, bricks: Bricks, corrections, refine, stale):
    """Find the cells in which trilinear interpolation misses the middle of an edge, of a face or of the cell.

    Args:
        window: with its coarse values.
        patches: the surface.
        bricks: the truncated distances.
        corrections: (n, 125) of all refined cells.
        refine: of the window's shape, written: the cell above the node is to be refined.
        stale: of the window's shape, written: what is stored of it misses one of its middles, too.
    """
    shape, middle = window.value.shape, window.ratio // 2
    for i in range(shape[0] - 1):
        for j in range(shape[1] - 1):
            for k in range(shape[2] - 1):
                plain, most, known = _corners(window, i, j, k)
                refine[i, j, k], stale[i, j, k] = False, False
                number = window.block[i, j, k]
                if not known:
                    continue
                for m in range(27):
                    a, b, c = (m // 9) * middle, ((m // 3) % 3) * middle, (m % 3) * middle
                    if number < 0 and a != middle and b != middle and c != middle:
                        continue
                    line = _between(window.value, i, j, k, a, b, c, window.ratio)
                    fine = _fine_value(window, patches, bricks, i, j, k, a, b, c, plain)
                    slack = TOLERANCE + SLACK * abs(line) + GUESS_SLACK * most
                    refine[i, j, k] |= abs(fine - line) > slack
                    if number >= 0:
                        stored = line + STEP * corrections[number, a * FINE * FINE + b * FINE + c]
                        stale[i, j, k] |= abs(stored - fine) > 0.5 * slack
                    if refine[i, j, k] and (number < 0 or stale[i, j, k]):
                        break


@njit(cache=True, nogil=True)
@no_type_check
def refined_values(window: Window, patches: Patches, bricks: Bricks, cells, corrections):
    """Write the corrections of cells (n, 3): what interpolation of the corners misses at each of their fine nodes."""
    for n in range(len(cells)):
        i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
        plain, _, _ = _corners(window, i, j, k)
        for a in range(FINE):
            for b in range(FINE):
                for c in range(FINE):
                    line = _between(window.value, i, j, k, a, b, c, window.ratio)
                    steps = (_fine_value(window, patches, bricks, i, j, k, a, b, c, plain) - line) / STEP
                    steps = max(-127.0, min(127.0, steps))
                    corrections[window.block[i, j, k], (a * FINE + b) * FINE + c] = int(np.floor(steps + 0.5))


@njit(cache=True, nogil=True)
@no_type_check
def _fine_value(window, patches, bricks, i, j, k, a, b, c, plain):
    """Distance [m] of the fine node (a, b, c) steps into the cell above node (i, j, k) of the window."""
    at = (i * window.ratio + a, j * window.ratio + b, k * window.ratio + c)
    upper, side, _ = _nearest_patch(window, patches, bricks.voxel, at)
    sign = _sign(window, bricks, at, side)
    if sign < 0:
        return -upper
    if plain:
        return upper
    # Free corners tell what to take off in free space, the others what to take off elsewhere.
    seen, free, taken_free, other, taken_other = 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(2):
        for q in range(2):
            for r in range(2):
                w = _corner_weight(p, q, r, a, b, c, window.ratio)
                seen += w * window.evidence[i + p, j + q, k + r]
                if window.state[i + p, j + q, k + r] > 0:
                    free += w
                    taken_free += w * window.taken[i + p, j + q, k + r]
                else:
                    other += w
                    taken_other += w * window.taken[i + p, j + q, k + r]
    if sign > 0 or seen > FREE_ABOVE:
        return upper - min(upper, taken_free / free if free > 0 else 0.0)
    return upper - min(2 * upper, taken_other / other if other > 0 else taken_free / free)


@njit(cache=True, nogil=True)
@no_type_check
def _sign(window, bricks, at, side):
    """Side of the seen surfaces a fine node lies on by the fused distances: 1, -1, or 0 where none was fused."""
    distance, weight = voxel_at(
        bricks,
        window.first[0] * window.ratio + at[0],
        window.first[1] * window.ratio + at[1],
        window.first[2] * window.ratio + at[2],
    )
    if weight <= 0:
        return 0
    # Within half a voxel of the surface the patch knows better.
    return 1 if (distance if abs(distance) > 0.5 * bricks.voxel else side) >= 0 else -1


@njit(cache=True, nogil=True)
@no_type_check
def _nearest_patch(window, patches, voxel, at):
    """Distance [m] of a fine node to the closest of the patches that are nearest around it, height above it, number."""
    x = voxel * (window.first[0] * window.ratio + at[0])
    y = voxel * (window.first[1] * window.ratio + at[1])
    z = voxel * (window.first[2] * window.ratio + at[2])
    best, side, number, last = np.float32(1e30), np.float32(1), 0, -1
    for i in range(at[0] // 2, (at[0] + 1) // 2 + 1):
        for j in range(at[1] // 2, (at[1] + 1) // 2 + 1):
            for k in range(at[2] // 2, (at[2] + 1) // 2 + 1):
                n = patches.nearest[i, j, k]
                if n == last:
                    continue
                last = n
                a = np.float32(x - patches.centre[n, 0])
                b = np.float32(y - patches.centre[n, 1])
                c = np.float32(z - patches.centre[n, 2])
                height = a * patches.normal[n, 0] + b * patches.normal[n, 1] + c * patches.normal[n, 2]
                across = np.sqrt(max(np.float32(0), a * a + b * b + c * c - height * height)) - patches.radius
                across = max(0.0, across)
                square = np.float32(across * across + height * height)
                if square < best:
                    best, side, number = square, height, n
    return np.sqrt(best), side, number


@njit(cache=True, nogil=True)
@no_type_check
def _corners(window, i, j, k):
    """Of a cell: whether all corners are free with nothing taken off, how much is at most [m], is any state known."""
    plain, most, known = True, np.float32(0), False
    for p in range(2):
        for q in range(2):
            for r in range(2):
                state, taken = window.state[i + p, j + q, k + r], window.taken[i + p, j + q, k + r]
                plain &= state > 0 and taken <= 0
                known |= state != 0
                if state >= 0:
                    most = max(most, taken)
    return plain, most, known


@njit(cache=True, nogil=True)
@no_type_check
def _corner_weight(p, q, r, a, b, c, ratio):
    """Weight of corner (p, q, r) of a cell in trilinear interpolation (a, b, c) fine steps into it."""
    return (a if p else ratio - a) * (b if q else ratio - b) * (c if r else ratio - c) / ratio**3


@njit(cache=True, nogil=True)
@no_type_check
def _between(value, i, j, k, a, b, c, ratio):
    """Trilinear interpolation of a cell's corners at (a, b, c) fine steps into it."""
    line = 0.0
    for p in range(2):
        for q in range(2):
            for r in range(2):
                line += _corner_weight(p, q, r, a, b, c, ratio) * value[i + p, j + q, k + r]
    return line
