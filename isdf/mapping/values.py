"""Distances at the nodes of a window: from the nearest seeds, from what was looked through, and from the guesses."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from .bricks import Bricks, voxel_at
from .evidence import FREE_ABOVE, SURFACE_REACH

# Errors above this [m] are what the confidence is about.
LARGE_ERROR = 0.05
# Odds that a well-seen seed is wrong by that much, how much greater they are for one hardly seen, and the weight
# (in measurements at 1 m) that makes the difference; read off seeds of a simulated office.
SEED_ODDS, FAINT_ODDS, FAINT_WEIGHT = 0.003, 0.15, 0.1
# In space looked through, a guess that takes off less than this share of its own expected error takes off nothing: the
# network's sigmoid never reaches zero, but there the median mostly is zero.
LEAST_OF_ERROR = 0.5
# However sure the network is of a guess, it may err by this share of the gap more than it expects, and so much [m] at
# most: rooms differ from those it has learned from.
UNFORESEEN, MOST_UNFORESEEN = np.float32(0.09), np.float32(0.017)


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
                upper, side, seed = nearest_patch(window, patches, bricks.voxel, at)
                sign = fused_sign(window, bricks, at, side)
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
                error = gap * np.exp(window.width[i, j, k]) + min(UNFORESEEN * gap, MOST_UNFORESEEN)
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
def fused_sign(window, bricks, at, side):
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
def nearest_patch(window, patches, voxel, at):
    """Distance [m] of a fine node to the closest of the patches that are nearest around it, height above it, number."""
    x = voxel * (window.first[0] * window.ratio + at[0])
    y = voxel * (window.first[1] * window.ratio + at[1])
    z = voxel * (window.first[2] * window.ratio + at[2])
    radius = np.float32(patches.radius)
    best, side, number, last = np.float32(1e30), np.float32(1), 0, -1
    # No patch is nearer whose centre is farther than that [m^2].
    enough = np.float32(1e30)
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
                away = a * a + b * b + c * c
                if away > enough:
                    continue
                height = a * patches.normal[n, 0] + b * patches.normal[n, 1] + c * patches.normal[n, 2]
                across = max(np.float32(0), np.sqrt(max(np.float32(0), away - height * height)) - radius)
                square = across * across + height * height
                if square < best:
                    best, side, number = square, height, n
                    enough = square + radius * (radius + np.float32(2) * np.sqrt(square))
    return np.sqrt(best), side, number
