"""Fusing depth images into bricks: projective, weighted by the noise of the depth, and forgetting what is contradicted.

Curless and Levoy (1996) and Newcombe et al. (ISMAR 2011), with weights of inverse squared variance. What is new is
that evidence which a view contradicts loses its weight at once, so that moved things vanish and appear in some frames.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.ndimage import minimum_filter

from .bricks import Bricks

# Nearer than this [m] the noise of depth cameras no longer falls with the square of the depth.
NOISE_FLOOR_DEPTH = 0.5
# Contradicted evidence counts as much as this many views like the one that contradicts it: fewer where all rays around
# go on far behind it, which is not the frayed edge of something that is still there.
TRUST, TRUST_SEEN_THROUGH = 8.0, 1.0
# How far around, as the tangent of an angle, and how far behind, in truncations.
AROUND, FAR_BEHIND = 0.015, 1.5
# Evidence of a surface that a view gives which ends before a voxel, beside 1 of one that ends within a voxel of it and
# none of one that goes on behind it: the thing that hides the voxel may reach as far.
HIDDEN = 0.3


def nearest_around(depth: Float[np.ndarray, "h w"], focal: float) -> Float[np.ndarray, "h w"]:
    """The least depth [m] around every pixel, 0 where one of them has none; `focal` is the focal length [px]."""
    return minimum_filter(depth, size=2 * max(1, round(AROUND * focal)) + 1, mode="nearest")


@njit(cache=True, nogil=True)
@no_type_check
def fuse(bricks: Bricks, begin, end, depth, around, noise, least, max_weight, intrinsics, T_camera_world):
    """Average one depth image into the stored voxels of a box of bricks, in place.

    Args:
        bricks: changed.
        begin: (3,) first brick of the box, as array index.
        end: (3,) one past its last.
        depth: (h, w) float32 z-depth [m], 0 = unknown.
        around: (h, w) float32, `nearest_around` of it.
        noise: truncation per squared depth.
        least: least truncation [m].
        max_weight: limit of a voxel's weight.
        intrinsics: fx, fy, cx, cy.
        T_camera_world: (4, 4).
    """
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    table, corner, distances, weights, ended, voxel = bricks
    radius = 7.0 * voxel
    for bi in range(begin[0], end[0]):
        for bj in range(begin[1], end[1]):
            for bk in range(begin[2], end[2]):
                brick = table[bi, bj, bk]
                if brick < 0:
                    continue
                x0, y0, z0 = (
                    voxel * 8 * (corner[0] + bi), voxel * 8 * (corner[1] + bj), voxel * 8 * (corner[2] + bk)
                )  # fmt: skip
                xm, ym, zm = x0 + 3.5 * voxel, y0 + 3.5 * voxel, z0 + 3.5 * voxel
                px = R[0, 0] * xm + R[0, 1] * ym + R[0, 2] * zm + t[0]
                py = R[1, 0] * xm + R[1, 1] * ym + R[1, 2] * zm + t[1]
                pz = R[2, 0] * xm + R[2, 1] * ym + R[2, 2] * zm + t[2]
                if pz < -radius:
                    continue
                if pz > radius:
                    reach = radius * 1.5 / (pz - radius + 1e-3)
                    if abs(px / pz * fx + cx - width / 2) > width / 2 + reach * fx:
                        continue
                    if abs(py / pz * fy + cy - height / 2) > height / 2 + reach * fy:
                        continue
                for i in range(8):
                    for j in range(8):
                        x, y = x0 + voxel * i, y0 + voxel * j
                        ax = R[0, 0] * x + R[0, 1] * y + t[0]
                        ay = R[1, 0] * x + R[1, 1] * y + t[1]
                        az = R[2, 0] * x + R[2, 1] * y + t[2]
                        for k in range(8):
                            w = z0 + voxel * k
                            z = az + R[2, 2] * w
                            if z < 0.05:
                                continue
                            u = int(np.floor((ax + R[0, 2] * w) / z * fx + cx + 0.5))
                            v = int(np.floor((ay + R[1, 2] * w) / z * fy + cy + 0.5))
                            if u < 0 or v < 0 or u >= width or v >= height:
                                continue
                            measured = depth[v, u]
                            if measured <= 0:
                                continue
                            band = max(least, noise * measured * measured)
                            ahead = measured - z
                            if ahead <= -band:
                                continue
                            far = max(measured, NOISE_FLOOR_DEPTH)
                            # Behind a surface less and less is known; what is there may be seen from its other side.
                            fade = min(1.0, (ahead + band) / (band - voxel))
                            weight = fade / (far * far * far * far)
                            at = i * 64 + j * 8 + k
                            old, before = distances[brick, at], weights[brick, at]
                            value = min(ahead, band)
                            if abs(value - old) > 0.75 * band:
                                through = around[v, u] - z > FAR_BEHIND * band
                                before = min(before, (TRUST_SEEN_THROUGH if through else TRUST) * weight)
                            total = before + weight
                            distances[brick, at] = (old * before + value * weight) / total
                            weights[brick, at] = min(total, max_weight)
                            kind = np.float32(1 if abs(ahead) <= voxel else (HIDDEN if ahead < 0 else 0))
                            ended[brick, at] = (ended[brick, at] * before + kind * weight) / total
