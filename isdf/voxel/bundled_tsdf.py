"""The "fast" TSDF integrator of Voxblox, which drops rays that would add little (Oleynikova et al., IROS 2017)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from .raycast import Rays, advance, flat_index, start_walk
from .volume import GrowingVolume

# One ray ends in each cell of this share of a voxel; one that met more than MAX_MEETINGS voxels in a row that other
# rays of the image had passed is given up. Pixels are taken from GROUPS places of the image in turn. As the library.
SUBSAMPLING, MAX_MEETINGS, GROUPS = 2, 2, 1024
TABLE_BITS = 20


CHANNELS: dict[str, type[np.generic]] = {"distance": np.float32, "weight": np.float32, "changed": np.uint8}


class BundledTsdf:
    """Fuses rays into the channels `distance` and `weight` of a volume, and sets `changed` where it does.

    Args:
        volume: with `CHANNELS`.
        truncation: of the distances [m].
        max_weight: bound of the weight of a voxel.
    """

    def __init__(self, volume: GrowingVolume, truncation: float, max_weight: float) -> None:
        self.volume, self.truncation, self.max_weight = volume, truncation, max_weight
        self._passed = np.zeros(0, dtype=np.int32)
        self._ended = np.zeros(1 << TABLE_BITS, dtype=np.int64)
        self._image = 0

    def fuse(self, rays: Rays) -> None:
        """Average one image's rays into the voxels they pass, from behind the surface towards the camera."""
        volume = self.volume
        if self._passed.size != np.prod(volume.shape):
            self._passed = np.zeros(int(np.prod(volume.shape)), dtype=np.int32)
        self._image += 1
        layers = tuple(volume.channels[name].reshape(-1) for name in CHANNELS)
        scales = (volume.voxel, float(self.truncation), float(self.max_weight))
        fuse_rays(rays, volume.shape, scales, layers, self._passed, self._ended, self._image)


@njit(cache=True, nogil=True)
@no_type_check
def fuse_rays(rays, shape, scales, layers, passed, ended, image):
    """Cast the rays of one image.

    Args:
        rays: `Rays`.
        shape: of the volume.
        scales: edge of a voxel [m], truncation [m], greatest weight.
        layers: flat distance, weight and changed, in place.
        passed: (voxels,) int32, the last image whose rays came through a voxel.
        ended: table of the last cell, with its image, in which a ray ended.
        image: number of this image, counted from 1.
    """
    voxel, truncation, _ = scales
    eye, ends = rays.eye, rays.ends
    cell, step = np.empty(3, np.int64), np.empty(3, np.int64)
    ahead, pace, far = np.empty(3), np.empty(3), np.empty(3)
    count = len(ends)
    group = count // GROUPS
    for turn in range(count):
        ray = turn if turn >= group * GROUPS else turn % GROUPS * group + turn // GROUPS
        if not _is_new(ends[ray], shape, ended, image):
            continue
        along = ends[ray] - eye
        length = np.sqrt((along**2).sum())
        along /= length
        far[:] = ends[ray] + along * (truncation / voxel)
        gain = 1.0 / rays.depths[ray] ** 2
        meetings = 0
        for n in range(start_walk(far, eye, cell, step, ahead, pace) + 1):
            if n > 0:
                advance(cell, step, ahead, pace)
            v = flat_index(cell, shape)
            if v < 0:
                continue
            meetings = meetings + 1 if passed[v] == image else 0
            passed[v] = image
            if meetings > MAX_MEETINGS:
                break
            before = (
                (cell[0] - eye[0]) * along[0] + (cell[1] - eye[1]) * along[1] + (cell[2] - eye[2]) * along[2]
            )
            _average(layers, v, (length - before) * voxel, gain, scales)


@njit(cache=True, nogil=True)
@no_type_check
def _is_new(end, shape, ended, image):
    """Whether no earlier ray of this image ended in the same cell."""
    key = 0
    for a in range(3):
        key = key * (SUBSAMPLING * shape[a] + SUBSAMPLING) + int(np.floor(SUBSAMPLING * (end[a] + 0.5)))
    slot = (key * 2654435761) & (len(ended) - 1)
    entry = (image << 36) | key
    if ended[slot] == entry:
        return False
    ended[slot] = entry
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _average(layers, v, measured, gain, scales):
    """Put one measurement [m] into a voxel; deeper than a voxel behind the surface it counts less and less."""
    distance, weight, changed = layers
    voxel, truncation, max_weight = scales
    if measured < -voxel:
        gain = max(gain * (truncation + measured) / (truncation - voxel), 0.0)
    total = weight[v] + gain
    if total < 1e-6:
        return
    mean = (measured * gain + distance[v] * weight[v]) / total
    distance[v] = min(max(mean, -truncation), truncation)
    weight[v] = min(total, max_weight)
    changed[v] = 1
