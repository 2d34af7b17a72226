"""Projective TSDF fusion weighted by the noise of the depth (Curless and Levoy, 1996; Newcombe et al., ISMAR 2011)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from ..errors import ConfigError
from ..frames import DepthFrame
from ..numbers import require_finite
from .projection import pixel_of, projection
from .volume import GrowingVolume, usable_depth

# Nearer than this [m] the noise of depth cameras no longer falls with the square of the depth.
NOISE_FLOOR_DEPTH = 0.5


@dataclass(frozen=True)
class TsdfConfig:
    """How depth images are fused.

    Args:
        voxel: edge of a voxel [m]; below 4 cm rooms gain nothing.
        truncation_voxels: least truncation in voxels, so that a zero crossing has values on both sides.
        truncation: least truncation [m], some standard deviations of near depth.
        truncation_noise: truncation per squared depth [m / m^2]: it follows the noise of far depth.
        max_depth: pixels measured farther than this are ignored [m].
        max_weight: of a voxel, in measurements at 1 m: enough to average the noise, and lower forgets sooner what has
            moved. A measurement at depth z weighs z^-4 of one at 1 m, so things seen from near fade slowly from afar.
        max_voxels: a frame that needs a larger volume is refused.
    """

    voxel: float = 0.04
    truncation_voxels: float = 3.0
    truncation: float = 0.12
    truncation_noise: float = 0.012
    max_depth: float = 12.0
    max_weight: float = 20.0
    max_voxels: int = 64_000_000

    def __post_init__(self) -> None:
        require_finite(self)
        positive = ("voxel", "truncation", "max_depth", "max_weight", "max_voxels")
        for name in positive:
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if not self.truncation_voxels > 1 or not self.truncation_noise >= 0:
            raise ConfigError(
                "truncation_voxels must be more than 1 and truncation_noise zero or more, got "
                f"{self.truncation_voxels} and {self.truncation_noise}"
            )

    def band(self, depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Truncation distance [m] at measured z-depths [m]."""
        least = max(self.truncation_voxels * self.voxel, self.truncation)
        return np.maximum(self.truncation_noise * depth * depth, np.float32(least))


class TsdfVolume(GrowingVolume):
    """Truncated signed distances [m] and their weights; a voxel of weight 0 was never observed.

    Args:
        config: see `TsdfConfig`.
    """

    def __init__(self, config: TsdfConfig) -> None:
        super().__init__(config.voxel, {"distance": np.float32, "weight": np.float32}, config.max_voxels)
        self.config = config

    @property
    def distance(self) -> Float[np.ndarray, "nx ny nz"]:
        """Weighted mean of the truncated distances along the viewing axis [m], positive in front of surfaces."""
        return self.channels["distance"]

    @property
    def weight(self) -> Float[np.ndarray, "nx ny nz"]:
        """Sum of the weights of all measurements, up to `max_weight`."""
        return self.channels["weight"]

    def fuse(self, frame: DepthFrame) -> None:
        """Average one frame into every voxel in front of its surfaces, or within the truncation behind them.

        Raises:
            FrameError: nothing within `max_depth`, or the volume would grow too large; nothing has changed.
        """
        config = self.config
        depth = usable_depth(frame, config.max_depth)
        band = config.band(depth)
        begin, end = self.include_frame(frame, np.where(depth > 0, depth + band, 0))
        gain = np.maximum(depth, NOISE_FLOOR_DEPTH) ** -4
        images = tuple(np.ascontiguousarray(a, dtype=np.float32).reshape(-1) for a in (depth, band, gain))
        limits = np.array([self.voxel, config.max_weight], dtype=np.float32)
        average(projection(frame, self, begin, end), images, limits, self.distance, self.weight)


@njit(cache=True, nogil=True)
@no_type_check
def average(view, images, limits, distances, weights):
    """Put the distance to the surface that a voxel's pixel shows into the voxel's weighted mean.

    Args:
        view: `Projection` of the voxels that can have changed.
        images: flat float32 depth [m] (0 where unknown), truncation [m] and weight of every pixel.
        limits: (2,) float32, edge of a voxel [m] and greatest weight.
        distances: (nx, ny, nz) float32, changed in place.
        weights: (nx, ny, nz) float32, changed in place.
    """
    depth, bands, gains = images
    voxel, most = limits
    zero, one = np.float32(0), np.float32(1)
    for i in range(view.x.shape[1]):
        for j in range(view.y.shape[1]):
            for k in range(view.z.shape[1]):
                pixel, z = pixel_of(view, i, j, k)
                if pixel < 0 or depth[pixel] <= zero:
                    continue
                band, ahead = bands[pixel], depth[pixel] - z
                if not ahead > -band:
                    continue
                # Behind a surface less and less is known, and what is there may be seen from its other side.
                weight = gains[pixel] * min(max((ahead + band) / (band - voxel), zero), one)
                at = (view.begin[0] + i, view.begin[1] + j, view.begin[2] + k)
                before = weights[at]
                total = before + weight
                distances[at] = (distances[at] * before + min(ahead, band) * weight) / total
                weights[at] = min(total, most)
