"""The exact-distance map: distances to sub-voxel surface points of a TSDF, found by a feature transform."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from ..errors import ConfigError
from ..frames import DepthFrame
from .mapper import VoxelMapper, check_period
from .nearest_seed import NearestSeedField
from .projection import tiny_frame
from .surface import surface_seeds
from .tsdf import TsdfConfig, TsdfVolume


@dataclass(frozen=True)
class ExactConfig(TsdfConfig):
    """Fusion and distances of the exact-distance map.

    Args:
        rebuild_period: least frame time between two rebuilds of the distances [s]; 0 rebuilds with every frame.
        patch: radius of the surface patch around each seed [voxels]. Half a voxel closes the gaps between the seeds
            of neighbouring voxels: near surfaces, points alone are farther away than the surface they lie on.
    """

    rebuild_period: float = 1.0
    patch: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_period(self.rebuild_period)
        if not 0 <= self.patch <= 1:
            raise ConfigError(f"patch must be a radius between 0 and 1 voxel, got {self.patch}")


class ExactMapper(VoxelMapper):
    """Fuses depth into a TSDF and measures distances to its zero crossings; see `VoxelMapper` for the interface.

    Args:
        config: see `ExactConfig`.
    """

    FORMAT = "isdf-exact-map"
    config: ExactConfig
    volume: TsdfVolume

    def __init__(self, config: ExactConfig | None = None) -> None:
        config = config or ExactConfig()
        super().__init__(config, TsdfVolume(config))
        _compile()

    @classmethod
    def config_type(cls) -> type:
        """`ExactConfig`."""
        return ExactConfig

    def field(self) -> NearestSeedField:
        """An immutable snapshot of the distance field, at most `rebuild_period` of frame time old.

        Raises:
            NotReadyError: no frame was integrated yet, or none showed a surface.
        """
        return super().field()

    def _fuse(self, frame: DepthFrame) -> None:
        self.volume.fuse(frame)

    def _rebuild(self) -> NearestSeedField | None:
        seeds, volume = surface_seeds(self.volume), self.volume
        if len(seeds.voxel) == 0:
            return None
        empty = np.ones(volume.shape, dtype=bool)
        empty.reshape(-1)[seeds.voxel] = False
        holder = distance_transform_edt(empty, return_distances=False, return_indices=True)
        number = np.zeros(volume.shape, dtype=np.int32)
        number.reshape(-1)[seeds.voxel] = np.arange(len(seeds.voxel))
        signed = np.where(volume.weight > 0, volume.distance, np.float32(np.nan))
        position = (seeds.position * volume.voxel + volume.origin).astype(np.float32)
        return NearestSeedField(
            nearest=torch.from_numpy(number[tuple(holder)]),
            seeds=torch.from_numpy(position),
            normals=torch.from_numpy(seeds.normal),
            signed=torch.from_numpy(signed),
            origin=torch.from_numpy(volume.origin.astype(np.float32)),
            voxel=volume.voxel,
            patch=self.config.patch * volume.voxel,
            bounds=self._bounds,
        )


@functools.cache
def _compile() -> None:
    """Compile what runs later, so that no frame waits for it."""
    TsdfVolume(TsdfConfig()).fuse(tiny_frame())
