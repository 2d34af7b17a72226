"""Whether a new depth image agrees with the map, and where something has come into space that was free."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from .bricks import Bricks, voxel_at
from .field import query_one
from .lattice import LatticeArrays

# A measured point this far in front of all surfaces [m], plus so much times its squared depth, is a contradiction.
CLEAR, CLEAR_NOISE = 0.09, 0.015
# Confidence (255 is 1) above which the map is believed.
SURE = 150
# How far before a measured point a solid is searched for that the ray would have had to pass [m].
BACK = 0.32


@njit(cache=True, nogil=True)
@no_type_check
def compare(lattice: LatticeArrays, bricks: Bricks, depth, stride, intrinsics, T_world_camera):
    """Look up every `stride`-th measured point, and the end of the way to it that ought to be free, in the map.

    Args:
        lattice: the map.
        bricks: its fused distances.
        depth: (h, w) float32 z-depth [m], 0 = unknown.
        stride: in pixels.
        intrinsics: fx, fy, cx, cy.
        T_world_camera: (4, 4).

    Returns:
        `appeared` (h / stride, w / stride), share of contradictions among the pixels that could be judged, and those as
        a share of all with a depth.
    """
    fx, fy, cx, cy = intrinsics
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    rows, columns = -(-depth.shape[0] // stride), -(-depth.shape[1] // stride)
    appeared = np.zeros((rows, columns), dtype=np.bool_)
    known, against, valid = 0, 0, 0
    steps = int(np.ceil(BACK / bricks.voxel))
    ray, point = np.empty(3), np.empty(3)
    for row in range(rows):
        for column in range(columns):
            v, u = row * stride, column * stride
            z = depth[v, u]
            if z <= 0:
                continue
            valid += 1
            a, b = (u - cx) / fx, (v - cy) / fy
            clear = CLEAR + CLEAR_NOISE * z * z
            for axis in range(3):
                ray[axis] = R[axis, 0] * a + R[axis, 1] * b + R[axis, 2]
                point[axis] = t[axis] + z * ray[axis]
            distance, sure, seen = query_one(lattice, point)
            if sure >= SURE and seen and distance > clear:
                appeared[row, column] = True
                known += 1
                against += 1
                continue
            through = False
            for n in range(1, steps + 1):
                at = (z - clear - (n - 1) * bricks.voxel) / bricks.voxel
                value, weight = voxel_at(
                    bricks,
                    int(np.floor(t[0] / bricks.voxel + at * ray[0] + 0.5)),
                    int(np.floor(t[1] / bricks.voxel + at * ray[1] + 0.5)),
                    int(np.floor(t[2] / bricks.voxel + at * ray[2] + 0.5)),
                )
                through |= weight > 0 and value < -bricks.voxel
            if through:
                against += 1
            if through or (sure >= SURE and abs(distance) < clear):
                known += 1
    return appeared, against / max(known, 1), known / max(valid, 1)
