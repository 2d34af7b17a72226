"""The fastest speeds along a path within velocity and acceleration limits: TOPP-RA (Pham and Pham, T-RO 2018)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

PRECISION = 1e-7  # of the greatest speeds, relative
SLIGHT = 1e-12  # slopes below count as none: the joint does not care how the path speeds up


@njit(cache=True, nogil=True)
@no_type_check
def path_speeds(
    ds: np.ndarray, slope: np.ndarray, bend: np.ndarray, v_max: np.ndarray, a_max: np.ndarray
) -> np.ndarray:
    """Squared path speeds x (n,) from rest to rest.

    Backwards, the greatest x of every point from which the end can still be reached at rest; forwards, the greatest
    acceleration that stays below these. Accelerations q' u + q'' x are held at both ends of every interval (the
    paper's first-order interpolation). Standing still is always within the limits, so the controllable sets start
    at 0 and none is empty.

    Args:
        ds: (n - 1,) intervals of the path parameter.
        slope: (n, dof) q' = dq/ds.
        bend: (n, dof) q''.
        v_max: (dof,) finite.
        a_max: (dof,) finite.
    """
    n = len(slope)
    highest = np.zeros(n)
    for i in range(n - 2, -1, -1):
        highest[i] = _highest(ds[i], slope[i : i + 2], bend[i : i + 2], v_max, a_max, highest[i + 1])
    x = np.zeros(n)
    for i in range(n - 1):
        _, most = _accelerations(ds[i], slope[i : i + 2], bend[i : i + 2], a_max, x[i])
        x[i + 1] = max(0.0, min(x[i] + 2.0 * ds[i] * most, highest[i + 1]))
    return x


@njit(cache=True, nogil=True)
@no_type_check
def _highest(
    ds: float, slope: np.ndarray, bend: np.ndarray, v_max: np.ndarray, a_max: np.ndarray, after: float
) -> float:
    """The greatest x from which one interval leads to at most `after`; the set of such x is an interval from 0."""
    cap = np.inf
    reach = np.inf
    for j in range(len(v_max)):
        if abs(slope[0, j]) > SLIGHT:
            cap = min(cap, (v_max[j] / slope[0, j]) ** 2)
            reach = min(reach, a_max[j] / abs(slope[0, j]))
    low, high = 0.0, min(cap, after + 2.0 * ds * reach)
    while _leads_to(ds, slope, bend, a_max, after, high):
        if high >= cap:
            return cap
        low, high = high, min(cap, 2.0 * high)
    while high - low > PRECISION * high:
        middle = 0.5 * (low + high)
        if _leads_to(ds, slope, bend, a_max, after, middle):
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
@no_type_check
def _leads_to(
    ds: float, slope: np.ndarray, bend: np.ndarray, a_max: np.ndarray, after: float, x: float
) -> bool:
    """Whether some acceleration is allowed at x that ends an interval between 0 and `after`."""
    least, most = _accelerations(ds, slope, bend, a_max, x)
    return least <= most and x + 2.0 * ds * least <= after and x + 2.0 * ds * most >= 0.0


@njit(cache=True, nogil=True)
@no_type_check
def _accelerations(
    ds: float, slope: np.ndarray, bend: np.ndarray, a_max: np.ndarray, x: float
) -> tuple[float, float]:
    """Path accelerations u allowed over an interval that starts at x; least above greatest where none is."""
    least, most = -np.inf, np.inf
    for k in range(2):
        for j in range(len(a_max)):
            factor = slope[k, j] + 2.0 * ds * k * bend[k, j]  # x at the far end is x + 2 ds u
            offset = bend[k, j] * x
            if abs(factor) > SLIGHT:
                first, second = (-a_max[j] - offset) / factor, (a_max[j] - offset) / factor
                least, most = max(least, min(first, second)), min(most, max(first, second))
            elif abs(offset) > a_max[j]:
                return np.inf, -np.inf
    return least, most
