"""Projective TSDF fusion weighted by the noise of the depth (Curless and Levoy, 1996; Newcombe et al., ISMAR 2011)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..errors import ConfigError
from ..frames import DepthFrame
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
        begin, end = self.include_frame(frame, np.where(depth > 0, depth + config.band(depth), 0))
        distances, weights = self.distance.reshape(-1), self.weight.reshape(-1)
        for index, z, measured in self.sights(frame, depth, begin, end):
            band, ahead = config.band(measured), measured - z
            near = np.flatnonzero(ahead > -band)
            index, band, ahead, measured = index[near], band[near], ahead[near], measured[near]
            weight = np.maximum(measured, NOISE_FLOOR_DEPTH) ** -4
            # Behind a surface less and less is known, and what is there may be seen from its other side.
            weight *= np.clip((ahead + band) / (band - self.voxel), 0, 1)
            before = weights[index]
            total = before + weight
            distances[index] = (distances[index] * before + np.minimum(ahead, band) * weight) / total
            weights[index] = np.minimum(total, config.max_weight)
