"""The cost of gaps between spheres of one robot."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def pair_costs(
    centres: np.ndarray, radii: np.ndarray, pairs: np.ndarray, eps: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum over pairs of c(gap) (n,), its gradient by the centres (n, s, 3), and the least gap (n,) at n states.

    c is the hinge of CHOMP's equation 21: eps/2 - d below 0, (d - eps)^2 / (2 eps) up to eps, 0 beyond.
    """
    n = len(centres)
    cost, gradient, least = np.zeros(n), np.zeros(centres.shape), np.full(n, np.inf)
    for i in range(n):
        for p in range(len(pairs)):
            a, b = pairs[p]
            dx = centres[i, a, 0] - centres[i, b, 0]
            dy = centres[i, a, 1] - centres[i, b, 1]
            dz = centres[i, a, 2] - centres[i, b, 2]
            touching = radii[a] + radii[b]
            square = dx * dx + dy * dy + dz * dz
            reach = touching + max(eps, least[i])
            if square >= reach * reach:
                continue
            distance = math.sqrt(square)
            gap = distance - touching
            least[i] = min(least[i], gap)
            if gap >= eps:
                continue
            if gap < 0.0:
                cost[i] += 0.5 * eps - gap
                slope = -1.0
            else:
                cost[i] += (eps - gap) ** 2 / (2.0 * eps)
                slope = (gap - eps) / eps
            slope /= max(distance, 1e-9)
            gradient[i, a, 0] += slope * dx
            gradient[i, a, 1] += slope * dy
            gradient[i, a, 2] += slope * dz
            gradient[i, b, 0] -= slope * dx
            gradient[i, b, 1] -= slope * dy
            gradient[i, b, 2] -= slope * dz
    return cost, gradient, least
