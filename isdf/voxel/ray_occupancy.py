"""Log-odds occupancy by ray casting, as FIESTA fuses depth (Han et al., IROS 2019, IV-A)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from .raycast import Rays, advance, flat_index, start_walk
from .volume import GrowingVolume


class RayOccupancy:
    """Counts, image by image, the rays that end in each voxel and that pass it; the channels keep the evidence.

    Args:
        volume: with the channels `log_odds` (float32) and `observed` (uint8).
        gains: log odds added where at least as many rays of an image end as pass, and where fewer do.
        limits: least and greatest log odds.
    """

    def __init__(
        self, volume: GrowingVolume, gains: tuple[float, float], limits: tuple[float, float]
    ) -> None:
        self.volume, self.scales = volume, (*gains, *limits)
        self._counts = np.zeros((4, 0), dtype=np.int32)
        self._image = 0

    def fuse(self, rays: Rays) -> None:
        """Add the evidence of one image's rays."""
        volume = self.volume
        if self._counts.shape[1] != np.prod(volume.shape):
            self._counts = np.zeros((4, int(np.prod(volume.shape))), dtype=np.int32)
        self._image += 1
        touched = cast(rays, volume.shape, self._counts, self._image)
        layers = (volume.channels["log_odds"].reshape(-1), volume.channels["observed"].reshape(-1))
        weigh(touched, self._counts, layers, self.scales)


@njit(cache=True, nogil=True)
@no_type_check
def cast(rays, shape, counts, image):
    """Walk each ray from its end to the eye, until it meets a voxel that another ray of the image has passed.

    Args:
        rays: `Rays`.
        shape: of the volume.
        counts: (4, voxels) int32: rays that ended and rays that ended or passed, zero before; the last image whose
            rays ended in a voxel, and whose rays passed it.
        image: number of this image, counted from 1.

    Returns:
        Flat indices of the voxels that were counted, each once.
    """
    hits, total, ended, passed = counts[0], counts[1], counts[2], counts[3]
    touched, many = np.empty(hits.size, np.int32), 0
    cell, step = np.empty(3, np.int64), np.empty(3, np.int64)
    ahead, pace = np.empty(3), np.empty(3)
    for ray in range(len(rays.ends)):
        steps = start_walk(rays.ends[ray], rays.eye, cell, step, ahead, pace)
        v = flat_index(cell, shape)
        if v < 0:
            continue
        if total[v] == 0:
            touched[many] = v
            many += 1
        total[v] += 1
        hits[v] += 1
        if ended[v] == image:
            continue
        ended[v] = image
        for _ in range(steps):
            advance(cell, step, ahead, pace)
            v = flat_index(cell, shape)
            if v < 0:
                break
            if total[v] == 0:
                touched[many] = v
                many += 1
            total[v] += 1
            if passed[v] == image:
                break
            passed[v] = image
    return touched[:many].copy()


@njit(cache=True, nogil=True)
@no_type_check
def weigh(touched, counts, layers, scales):
    """Turn the counts of one image into evidence and set them back to zero."""
    log_odds, observed = layers
    hit, miss, least, greatest = scales
    for v in touched:
        gain = hit if 2 * counts[0, v] >= counts[1, v] else miss
        log_odds[v] = min(max(log_odds[v] + gain, least), greatest)
        observed[v] = 1
        counts[0, v] = 0
        counts[1, v] = 0
