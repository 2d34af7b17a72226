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

from .bricks import SIDE, VOXELS, Bricks

# Nearer than this [m] the noise of depth cameras no longer falls with the square of the depth.
NOISE_FLOOR_DEPTH = 0.5
# Contradicted evidence counts as much as this many views like the one that contradicts it: fewer where all rays around
# go on far behind it, which is not the frayed edge of something that is still there.
TRUST, TRUST_SEEN_THROUGH = 8.0, 1.0
# How far around, as the tangent of an angle, and how far behind, in truncations.
AROUND, FAR_BEHIND = 0.015, 1.5
# Voxels nearer to the camera's plane than this [m] are not looked at.
NEAREST = 0.05
# Pixels a side of the tiles of an image whose greatest depths tell which bricks are hidden.
TILE = 16


def nearest_around(depth: Float[np.ndarray, "h w"], focal: float) -> Float[np.ndarray, "h w"]:
    """The least depth [m] around every pixel, 0 where one of them has none; `focal` is the focal length [px]."""
    return minimum_filter(depth, size=2 * max(1, round(AROUND * focal)) + 1, mode="nearest")


@njit(cache=True, nogil=True)
@no_type_check
def fuse(bricks: Bricks, begin, end, depth, around, noise, least, max_weight, intrinsics, T_camera_world):
    """Average one depth image into the stored voxels of a box of bricks, in place.

    Args:
        bricks: changed, and counted where anything is.
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
    table, corner, distances, weights, ended, voxel, changes = bricks
    K, T = np.array(intrinsics, dtype=np.float32), T_camera_world.astype(np.float32)
    bands, first = (
        np.array((noise, least, max_weight, voxel), dtype=np.float32),
        np.empty(3, dtype=np.float32),
    )
    deepest, flat, flat_around = _deepest(depth), depth.ravel(), around.ravel()
    pixels, z = np.empty(VOXELS, dtype=np.int32), np.empty(VOXELS, dtype=np.float32)
    for bi in range(begin[0], end[0]):
        for bj in range(begin[1], end[1]):
            for bk in range(begin[2], end[2]):
                brick = table[bi, bj, bk]
                if brick < 0:
                    continue
                first[0] = voxel * SIDE * (corner[0] + bi)
                first[1] = voxel * SIDE * (corner[1] + bj)
                first[2] = voxel * SIDE * (corner[2] + bk)
                if _may_change(first, bands, deepest, depth.shape, K, T):
                    _project(first, bands[3], depth.shape, K, T, pixels, z)
                    changes[brick] += _average(
                        distances[brick], weights[brick], ended[brick], pixels, z, flat, flat_around, bands
                    )


@njit(cache=True, nogil=True)
@no_type_check
def _deepest(depth):
    """Greatest depth [m] in every tile of an image."""
    height, width = depth.shape
    out = np.zeros((-(-height // TILE), -(-width // TILE)), dtype=np.float32)
    for v in range(height):
        for u in range(width):
            out[v // TILE, u // TILE] = max(out[v // TILE, u // TILE], depth[v, u])
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _may_change(first, bands, deepest, shape, K, T):
    """Whether the ball about a brick is in view and not wholly hidden: (3,) `first` is its first voxel [m]."""
    noise, least, voxel = bands[0], bands[1], bands[3]
    half = np.float32(0.5 * (SIDE - 1)) * voxel
    radius = np.float32(1.7321) * half
    x, y, z = first[0] + half, first[1] + half, first[2] + half
    px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    near = pz - radius
    if pz + radius < NEAREST:
        return False
    if near < NEAREST:
        return True
    # No point of the ball is farther from its middle in the image, for none is nearer than `near`.
    reach = radius * (1 + max(abs(px), abs(py)) / pz) / near
    low_u, high_u = (px / pz - reach) * K[0] + K[2] - 1, (px / pz + reach) * K[0] + K[2] + 1
    low_v, high_v = (py / pz - reach) * K[1] + K[3] - 1, (py / pz + reach) * K[1] + K[3] + 1
    if high_u < 0 or high_v < 0 or low_u >= shape[1] or low_v >= shape[0]:
        return False
    u0, u1 = max(0, int(low_u)) // TILE, min(shape[1] - 1, int(high_u)) // TILE
    v0, v1 = max(0, int(low_v)) // TILE, min(shape[0] - 1, int(high_v)) // TILE
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            far = deepest[v, u]
            if far > 0 and near < far + max(least, noise * far * far):
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _project(first, voxel, shape, K, T, pixels, z):
    """Write which pixel every voxel of a brick falls on, -1 if on none, and its z-depth [m]; made to be vectorised."""
    width, high, wide = np.int32(shape[1]), np.float32(shape[0]), np.float32(shape[1])
    half, one = np.float32(0.5), np.float32(1)
    fx, fy, cx, cy = K[0], K[1], K[2] + half, K[3] + half
    r0, r1, r2 = voxel * T[0, 2], voxel * T[1, 2], voxel * T[2, 2]
    for i in range(SIDE):
        for j in range(SIDE):
            x, y = first[0] + voxel * np.float32(i), first[1] + voxel * np.float32(j)
            ax = T[0, 0] * x + T[0, 1] * y + T[0, 2] * first[2] + T[0, 3]
            ay = T[1, 0] * x + T[1, 1] * y + T[1, 2] * first[2] + T[1, 3]
            az = T[2, 0] * x + T[2, 1] * y + T[2, 2] * first[2] + T[2, 3]
            for k in range(SIDE):
                step = np.float32(k)
                depth = az + r2 * step
                inverse = one / max(depth, np.float32(NEAREST))
                u, v = (ax + r0 * step) * inverse * fx + cx, (ay + r1 * step) * inverse * fy + cy
                seen = (depth >= np.float32(NEAREST)) & (u >= 0) & (v >= 0) & (u < wide) & (v < high)
                at = (i * SIDE + j) * SIDE + k
                z[at] = depth
                pixels[at] = np.int32(v) * width + np.int32(u) if seen else np.int32(-1)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _average(distances, weights, ended, pixels, z, depth, around, bands):
    """Average what an image measures into the voxels (512,) of a brick; returns whether that is anything."""
    noise, least, max_weight, voxel = bands
    some = False
    floor, one = np.float32(NOISE_FLOOR_DEPTH), np.float32(1)
    for at in range(VOXELS):
        pixel = pixels[at]
        if pixel < 0:
            continue
        measured = depth[pixel]
        if measured <= 0:
            continue
        band = max(least, noise * measured * measured)
        ahead = measured - z[at]
        if ahead <= -band:
            continue
        far = max(measured, floor)
        # Behind a surface less and less is known; what is there may be seen from its other side.
        known = min(one, (ahead + band) / (band - voxel))
        weight = known * known / (far * far * far * far)
        old, before = distances[at], weights[at]
        value = min(ahead, band)
        # And it contradicts only what says that there is free space, not the back of a board that was seen, too.
        if (old if ahead < 0 else abs(value - old)) > np.float32(0.75) * band:
            through = around[pixel] - z[at] > np.float32(FAR_BEHIND) * band
            before = min(before, np.float32(TRUST_SEEN_THROUGH if through else TRUST) * weight)
        total = before + weight
        share = weight / total
        distances[at] = old + (value - old) * share
        weights[at] = min(total, max_weight)
        kind = one if abs(ahead) <= voxel else np.float32(0)
        ended[at] += (kind - ended[at]) * share
        some = True
    return some
