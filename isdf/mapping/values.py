"""Distances at the nodes of a window: from the nearest seeds, from what was looked through, and from the guesses."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from .bricks import Bricks, voxel_at
from .evidence import FREE_ABOVE, SURFACE_REACH
from .patches import Patches, patch_at

# Errors above this [m] are what the confidence is about.
LARGE_ERROR = 0.05
# Odds that a well-seen seed is wrong by that much, how much greater they are for one hardly seen, and the weight
# (in measurements at 1 m) that makes the difference; read off seeds of a simulated office.
SEED_ODDS, FAINT_ODDS, FAINT_WEIGHT = 0.003, 0.15, 0.1
# In space looked through, a guess that takes off less than this share of its own expected error takes off nothing: the
# network's sigmoid never reaches zero, but there the median mostly is zero. Behind a guessed back nothing is taken off
# either: the network has guessed from the front, and what lies between both is already accounted for.
LEAST_OF_ERROR = 0.5
# However sure the network is of a guess, it may err by this share of the gap more than it expects, and so much [m] at
# most: rooms differ from those it has learned from.
UNFORESEEN, MOST_UNFORESEEN = np.float32(0.09), np.float32(0.017)
# Straight behind a surface it is solid for this long [m], though no view ended there; straight is what is within this
# cosine of its normal.
SOLID, STRAIGHT = np.float32(0.1), np.float32(0.7)


class Window(NamedTuple):
    """A box of coarse nodes, and views of the lattice's arrays there, all of one shape.

    Args:
        first: (3,) lattice index of its first node.
        ratio: fine steps between coarse nodes.
        step: length of a fine step [m].
        voxels: of the fused distances in a fine step.
        evidence: uint8, see `isdf.mapping.evidence`.
        upper: float32, upper bounds [m].
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
    step: float
    voxels: int
    evidence: np.ndarray
    upper: np.ndarray
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
                upper, height, weight = patch_at(window, patches, (2 * i, 2 * j, 2 * k))
                sign = side_of(window, bricks, at, upper, height, weight, window.evidence[i, j, k])
                low = min(window.lower[i, j, k], upper)
                if sign < 0:
                    low = upper
                elif sign > 0:
                    low = max(low, np.float32(0))
                elif upper < SURFACE_REACH * window.ratio * window.step:
                    low = -upper
                else:
                    low = max(min(low, np.float32(0)), -upper)
                gap = upper - low
                error = gap * np.exp(window.width[i, j, k]) + min(UNFORESEEN * gap, MOST_UNFORESEEN)
                share = window.share[i, j, k]
                if sign > 0 and (weight <= 0 or share < LEAST_OF_ERROR * np.exp(window.width[i, j, k])):
                    share = np.float32(0)
                window.taken[i, j, k] = 2 * upper if sign < 0 else gap * share
                window.value[i, j, k] = upper - window.taken[i, j, k]
                window.state[i, j, k] = sign
                faint = FAINT_WEIGHT / (weight + FAINT_WEIGHT)
                odds = SEED_ODDS + FAINT_ODDS * faint
                # The guess's error is Laplace distributed: its chance to be small, times that of the seed.
                chance = (1 - np.exp(-LARGE_ERROR / max(error, np.float32(1e-3)))) / (1 + odds)
                # Nobody has looked there: never more likely right than wrong.
                chance = chance if sign != 0 and weight > 0 else 0.5 * chance
                window.confidence[i, j, k] = int(255 * chance + 0.5)


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def fused_at(window, bricks, at):
    """Fused distance [m] and weight of a fine node."""
    return voxel_at(
        bricks,
        window.voxels * (window.first[0] * window.ratio + at[0]),
        window.voxels * (window.first[1] * window.ratio + at[1]),
        window.voxels * (window.first[2] * window.ratio + at[2]),
    )


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def side_of(window, bricks, at, upper, height, weight, seen):
    """Side of the surfaces a fine node lies on: 1, -1, or 0 where it is not known.

    Args:
        window: where.
        bricks: the fused distances.
        at: the node.
        upper: distance to the nearest patch [m].
        height: above that patch [m].
        weight: of that patch, 0 if it is a guess.
        seen: evidence that the node is free.
    """
    # Views that ended on a board are fused behind its back, too, as if it went on. And just inside it is solid.
    if weight <= 0 and upper < SOLID and height > -0.5 * bricks.voxel:
        return 1 if height > 0 else -1
    distance, views = fused_at(window, bricks, at)
    if views > 0:
        # Within half a voxel of the surface the patch knows better.
        return 1 if (distance if abs(distance) > 0.5 * bricks.voxel else height) >= 0 else -1
    # What is looked through so near to a surface is fused; the coarser evidence of free space may come from before it.
    if upper < SOLID and height < -STRAIGHT * upper:
        return -1
    return 1 if seen > FREE_ABOVE else 0
