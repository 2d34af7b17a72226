"""The cost of gaps between spheres of one robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

ROUNDING = 1e-5  # [m] that single precision may lose


class PairGroups(NamedTuple):
    """Pairs of spheres in groups that one test can tell to be apart; made by `grouped`."""

    pairs: np.ndarray  # (p, 2) spheres
    first: np.ndarray  # (g + 1,) first pair of each group, and the number of pairs
    anchor: np.ndarray  # (g, 2) a sphere of each of the two links
    reach: np.ndarray  # (g,) sum of how far the links' spheres reach from their anchors [m]


def grouped(
    pairs: np.ndarray, links: Sequence[str] | None, centres: np.ndarray, radii: np.ndarray
) -> PairGroups:
    """Group pairs (p, 2) by the rigid links of their spheres.

    Args:
        pairs: pairs of the same two links next to each other are one group.
        links: of the spheres; without them every pair is a group.
        centres: (s, 3) of the spheres in any one state [m].
        radii: (s,) [m].
    """
    names = np.arange(len(radii)) if links is None else np.unique(links, return_inverse=True)[1]
    anchors = np.unique(names, return_index=True)[1][names]  # the first sphere of each sphere's link
    out = np.linalg.norm(centres - centres[anchors], axis=1) + radii
    reach = np.array([out[names == name].max() for name in range(names.max() + 1)])
    of_pair = names[pairs]
    first = np.flatnonzero(np.r_[True, (np.diff(of_pair, axis=0) != 0).any(axis=1)])
    return PairGroups(
        np.ascontiguousarray(pairs, np.int64),
        np.r_[first, len(pairs)].astype(np.int64),
        np.ascontiguousarray(anchors[pairs[first]], np.int64),
        reach[of_pair[first]].sum(axis=1) + ROUNDING,
    )


@njit(cache=True, nogil=True)
@no_type_check
def pair_costs(
    centres: np.ndarray, radii: np.ndarray, groups: PairGroups, eps: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum over pairs of c(gap) (n,), its gradient by the centres (n, s, 3), and the least gap (n,) at n states.

    c is the hinge of CHOMP's equation 21: eps/2 - d below 0, (d - eps)^2 / (2 eps) up to eps, 0 beyond.
    """
    n = len(centres)
    cost, gradient, least = np.zeros(n), np.zeros(centres.shape), np.full(n, np.inf)
    for i in range(n):
        for g in range(len(groups.reach)):
            a, b = groups.anchor[g]
            apart = groups.reach[g] + max(eps, least[i])
            if not _square(centres[i, a], centres[i, b]) >= apart * apart:
                pairs = groups.pairs[groups.first[g] : groups.first[g + 1]]
                cost[i], least[i] = _add(centres[i], radii, pairs, eps, cost[i], least[i], gradient[i])
    return cost, gradient, least


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _square(a: np.ndarray, b: np.ndarray) -> float:
    dx, dy, dz = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
@no_type_check
def _add(
    x: np.ndarray,
    radii: np.ndarray,
    pairs: np.ndarray,
    eps: float,
    cost: float,
    least: float,
    gradient: np.ndarray,
) -> tuple[float, float]:
    """Cost and least gap with some pairs of one state added; their gradient is added in place."""
    for p in range(len(pairs)):
        a, b = pairs[p]
        touching = radii[a] + radii[b]
        square = _square(x[a], x[b])
        reach = touching + max(eps, least)
        if square >= reach * reach:
            continue
        distance = math.sqrt(square)
        gap = distance - touching
        least = min(least, gap)
        if gap >= eps:
            continue
        if gap < 0.0:
            cost += 0.5 * eps - gap
            slope = -1.0
        else:
            cost += (eps - gap) ** 2 / (2.0 * eps)
            slope = (gap - eps) / eps
        slope /= max(distance, 1e-9)
        for axis in range(3):
            push = slope * (x[a, axis] - x[b, axis])
            gradient[a, axis] += push
            gradient[b, axis] -= push
    return cost, least
