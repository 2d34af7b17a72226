"""Whether a new depth image agrees with the map, and where something has come into space that was free."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from .field import query_one
from .lattice import LatticeArrays

# A measured point this far in front of all surfaces [m], plus so much times its squared depth, is a contradiction.
CLEAR, CLEAR_NOISE = 0.09, 0.015
# Confidence (255 is 1) above which the map is believed.
SURE = 150


@njit(cache=True)
@no_type_check
def compare(lattice: LatticeArrays, depth, stride, intrinsics, T_world_camera):
    """Look up every `stride`-th measured point, and a point before it that ought to be free, in the map.

    Args:
        lattice: the map.
        depth: (h, w) float32 z-depth [m], 0 = unknown.
        stride: in pixels.
        intrinsics: fx, fy, cx, cy.
        T_world_camera: (4, 4).

    Returns:
        `appeared` (h / stride, w / stride), share of contradictions, number of pixels that could be judged.
    """
    fx, fy, cx, cy = intrinsics
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    rows, columns = -(-depth.shape[0] // stride), -(-depth.shape[1] // stride)
    appeared = np.zeros((rows, columns), dtype=np.bool_)
    known, against = 0, 0
    ray, point = np.empty(3), np.empty(3)
    for row in range(rows):
        for column in range(columns):
            v, u = row * stride, column * stride
            z = depth[v, u]
            if z <= 0:
                continue
            a, b = (u - cx) / fx, (v - cy) / fy
            clear = CLEAR + CLEAR_NOISE * z * z
            for axis in range(3):
                ray[axis] = R[axis, 0] * a + R[axis, 1] * b + R[axis, 2]
                point[axis] = t[axis] + z * ray[axis]
            distance, sure, seen = query_one(lattice, point)
            if sure < SURE:
                continue
            if seen and distance > clear:
                appeared[row, column] = True
                known += 1
                against += 1
                continue
            if abs(distance) < clear:
                known += 1
            for axis in range(3):
                point[axis] -= 2 * clear * ray[axis]
            distance, sure, seen = query_one(lattice, point)
            if sure >= SURE and not seen and distance < -0.02:
                against += 1
    return appeared, against / max(known, 1), known
