"""KinectFusion+, the iSDF paper's second baseline: occupancy fusion and Euclidean distance transforms."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
from numba import njit
from scipy.ndimage import distance_transform_edt

from ..errors import ConfigError
from ..frames import DepthFrame
from ..numbers import require_finite
from .mapper import VoxelMapper, check_period
from .projection import pixel_of, projection, tiny_frame
from .volume import GrowingVolume, usable_depth
from .voxel_field import VoxelField

# Bounds of the evidence of a voxel, in log odds: few contrary measurements can turn it.
LOG_ODDS_LIMITS = (-2.0, 3.5)
CHANNELS: dict[str, type[np.generic]] = {"log_odds": np.float32, "observed": np.float32}


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
        require_finite(self, ("rebuild_period",))
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
        super().__init__(config, GrowingVolume(config.voxel, CHANNELS, config.max_voxels))
        _compile()

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
        fuse(frame, self.volume, self.config)

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


def fuse(frame: DepthFrame, volume: GrowingVolume, config: KinectFusionConfig) -> None:
    """Add the evidence of one frame to the channels `log_odds` and `observed`.

    Raises:
        FrameError: nothing within `max_depth`, or the volume would grow too large; nothing has changed.
    """
    depth = usable_depth(frame, config.max_depth)
    behind = config.behind * config.voxel
    begin, end = volume.include_frame(frame, np.where(depth > 0, depth + behind, 0))
    weigh(
        projection(frame, volume, begin, end),
        np.ascontiguousarray(depth, dtype=np.float32).reshape(-1),
        np.array([config.front * config.voxel, behind], dtype=np.float32),
        (float(config.hit), float(config.miss)),
        volume.channels["log_odds"],
        volume.channels["observed"],
    )


@njit(cache=True, nogil=True)
@no_type_check
def weigh(view, depth, reach, evidence, log_odds, observed):
    """Add the evidence of the surface that a voxel's pixel shows.

    Args:
        view: `Projection` of the voxels that can have changed.
        depth: flat float32 z-depth of every pixel [m], 0 where unknown.
        reach: (2,) float32, how far before and behind a surface a voxel is hit [m].
        evidence: log odds of a hit, and those that a miss takes away.
        log_odds: (nx, ny, nz) float32, changed in place.
        observed: (nx, ny, nz) float32, set to 1.
    """
    least, greatest = LOG_ODDS_LIMITS
    for i in range(view.x.shape[1]):
        for j in range(view.y.shape[1]):
            for k in range(view.z.shape[1]):
                pixel, z = pixel_of(view, i, j, k)
                if pixel < 0 or depth[pixel] <= 0:
                    continue
                ahead = depth[pixel] - z
                if not ahead > -reach[1]:
                    continue
                at = (view.begin[0] + i, view.begin[1] + j, view.begin[2] + k)
                gain = evidence[0] if ahead < reach[0] else -evidence[1]
                log_odds[at] = min(max(log_odds[at] + gain, least), greatest)
                observed[at] = 1


@functools.cache
def _compile() -> None:
    """Compile what runs later, so that no frame waits for it."""
    config = KinectFusionConfig()
    fuse(tiny_frame(), GrowingVolume(config.voxel, CHANNELS, config.max_voxels), config)
