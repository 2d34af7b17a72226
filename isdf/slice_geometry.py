"""Horizontal directions in worlds whose up need not be z."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def slice_basis(up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rows: two horizontal directions and up, right-handed; the world's own axes when up is z."""
    up = up / np.linalg.norm(up)
    first = np.eye(3)[int(np.abs(up).argmin())]
    first = first - up * (first @ up)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def corners(bounds: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "8 3"]:
    """The eight corners of a box given by its lower and upper one."""
    return np.array(
        [[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
