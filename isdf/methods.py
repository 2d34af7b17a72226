"""The mapping methods by name, and the map files of all of them."""

from __future__ import annotations

from pathlib import Path

import torch

from . import checkpoint, mapfile
from .errors import CheckpointError, ConfigError
from .isdf_mapper import IsdfConfig, IsdfMapper
from .mapping import Mapper, MapperConfig
from .mapping.state import FORMAT as LATTICE_FORMAT
from .voxel import (
    ExactConfig,
    ExactMapper,
    FiestaConfig,
    FiestaMapper,
    KinectFusionConfig,
    KinectFusionMapper,
    VoxbloxConfig,
    VoxbloxMapper,
    VoxelMapper,
)

VoxelConfig = ExactConfig | VoxbloxConfig | FiestaConfig | KinectFusionConfig
Config = MapperConfig | IsdfConfig | VoxelConfig
OnlineMapper = Mapper | IsdfMapper | ExactMapper | VoxbloxMapper | FiestaMapper | KinectFusionMapper

_MAPPERS: dict[type, type[OnlineMapper]] = {
    MapperConfig: Mapper,
    IsdfConfig: IsdfMapper,
    ExactConfig: ExactMapper,
    VoxbloxConfig: VoxbloxMapper,
    FiestaConfig: FiestaMapper,
    KinectFusionConfig: KinectFusionMapper,
}
_FORMATS: dict[str, type[OnlineMapper]] = {
    LATTICE_FORMAT: Mapper,
    checkpoint.FORMAT: IsdfMapper,
    ExactMapper.FORMAT: ExactMapper,
    VoxbloxMapper.FORMAT: VoxbloxMapper,
    FiestaMapper.FORMAT: FiestaMapper,
    KinectFusionMapper.FORMAT: KinectFusionMapper,
}


def new_mapper(config: Config) -> OnlineMapper:
    """An empty map of the method that the configuration belongs to.

    Raises:
        ConfigError: it is none of the methods' configurations.
    """
    if type(config) not in _MAPPERS:
        raise ConfigError(
            f"no method has a {type(config).__name__}; pass a {', '.join(c.__name__ for c in _MAPPERS)}"
        )
    return _MAPPERS[type(config)](config)  # type: ignore[arg-type]


def load_map(path: str | Path, device: str | torch.device = "cpu") -> OnlineMapper:
    """Read a map file of any method, as its header says.

    Args:
        path: the file.
        device: where a network is to live, whatever device it was trained on; voxel maps are on the CPU.

    Raises:
        CheckpointError: the file is missing, damaged, of an unknown kind or of another version.
        ConfigError: a voxel map is wanted on another device.
    """
    found = mapfile.kind(Path(path))
    if found not in _FORMATS:
        raise CheckpointError(
            f"{path}: a map of format {found!r}; this release reads {', '.join(_FORMATS)}: update the package"
        )
    method = _FORMATS[found]
    if not issubclass(method, VoxelMapper):
        return method.load(path, device)
    if torch.device(device).type != "cpu":
        raise ConfigError(f"{path}: a voxel map ({found}) works on the CPU only, not on {device}")
    return method.load(path)
