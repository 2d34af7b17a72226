"""KinectFusion+, the iSDF paper's second baseline: occupancy fusion and Euclidean distance transforms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from ..errors import ConfigError
from ..frames import DepthFrame
from .mapper import VoxelMapper, check_period
from .volume import GrowingVolume, usable_depth
from .voxel_field import VoxelField

# Bounds of the evidence of a voxel, in log odds: few contrary measurements can turn it.
LOG_ODDS_LIMITS = (-2.0, 3.5)


@dataclass(frozen=True)
class KinectFusionConfig:
    """Occupancy fusion; the paper's voxel size.

    Args:
        voxel: edge of a voxel [m].
        front: a voxel is hit from this far in front of the measured surface, along the view [voxels]. More thickens
            surfaces, less lets rays at a flat angle wear them away.
        behind: and to this far behind it [voxels]; thin plates seen at a flat angle vanish with one voxel.
        hit: log odds added by a hit.
        miss: log odds taken away by a ray that passes through.
        max_depth: pixels measured farther than this are ignored [m].
        rebuild_period: least frame time between two rebuilds of the distances [s].
        max_voxels: a frame that needs a larger volume is refused.
    """

    voxel: float = 0.07
    front: float = 0.5
    behind: float = 2.0
    hit: float = 0.85
    miss: float = 0.4
    max_depth: float = 12.0
    rebuild_period: float = 1.0
    max_voxels: int = 64_000_000

    def __post_init__(self) -> None:
        for name in ("voxel", "behind", "hit", "miss", "max_depth", "max_voxels"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if not self.front >= 0:
            raise ConfigError(f"front must be zero or more voxels, got {self.front}")
        check_period(self.rebuild_period)


class KinectFusionMapper(VoxelMapper):
    """Occupancy grid, then the distance to the occupied minus the distance to the free voxels (paper, appendix).

    As in the paper every voxel starts free, so solids are shells: do not ask for distances where the confidence is 0.
    See `VoxelMapper` for the interface.

    Args:
        config: see `KinectFusionConfig`.
    """

    FORMAT = "isdf-kinectfusion-map"
    config: KinectFusionConfig

    def __init__(self, config: KinectFusionConfig | None = None) -> None:
        config = config or KinectFusionConfig()
        super().__init__(
            config,
            GrowingVolume(config.voxel, {"log_odds": np.float32, "observed": np.float32}, config.max_voxels),
        )

    @classmethod
    def config_type(cls) -> type:
        """`KinectFusionConfig`."""
        return KinectFusionConfig

    def field(self) -> VoxelField:
        """An immutable snapshot of the distance field, at most `rebuild_period` of frame time old.

        Raises:
            NotReadyError: no frame was integrated yet, or none showed a surface.
        """
        return super().field()

    def _fuse(self, frame: DepthFrame) -> None:
        config, volume = self.config, self.volume
        depth = usable_depth(frame, config.max_depth)
        behind = config.behind * config.voxel
        begin, end = volume.include_frame(frame, np.where(depth > 0, depth + behind, 0))
        log_odds, observed = (volume.channels[name].reshape(-1) for name in ("log_odds", "observed"))
        for index, z, measured in volume.sights(frame, depth, begin, end):
            ahead = measured - z
            near = np.flatnonzero(ahead > -behind)
            index, ahead = index[near], ahead[near]
            evidence = np.where(ahead < config.front * config.voxel, config.hit, -config.miss)
            log_odds[index] = np.clip(log_odds[index] + evidence, *LOG_ODDS_LIMITS)
            observed[index] = 1

    def _rebuild(self) -> VoxelField | None:
        occupied = self.volume.channels["log_odds"] > 0
        if not occupied.any():
            return None
        voxels = distance_transform_edt(~occupied) - distance_transform_edt(occupied)
        return VoxelField(
            torch.from_numpy((voxels * self.volume.voxel).astype(np.float32)),
            torch.from_numpy(self.volume.channels["observed"] > 0),
            torch.from_numpy(self.volume.origin.astype(np.float32)),
            self.volume.voxel,
            self._bounds,
        )
