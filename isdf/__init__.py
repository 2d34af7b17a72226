"""Neural signed distance fields learned online from posed depth images (iSDF; Ortiz et al., RSS 2022)."""

from .background import BackgroundMapper, Rates, Snapshot
from .camera import PinholeCamera
from .cost import CostField
from .display import plot_slice
from .errors import (
    BackgroundError,
    CameraError,
    CheckpointError,
    ConfigError,
    DatasetError,
    DivergedError,
    FrameError,
    IsdfError,
    NotReadyError,
    SourceError,
)
from .field import GridField, NeuralField, bake, query
from .frames import DepthFrame
from .isdf_mapper import IsdfConfig, IsdfMapper
from .keyframes import KeyframeConfig
from .losses import LossConfig
from .mapping import LatticeField, Mapper, MapperConfig
from .methods import load_map
from .network import NetworkConfig
from .sampling import SamplingConfig

__all__ = [
    "BackgroundError",
    "BackgroundMapper",
    "CameraError",
    "CheckpointError",
    "ConfigError",
    "CostField",
    "DatasetError",
    "DepthFrame",
    "DivergedError",
    "FrameError",
    "GridField",
    "IsdfConfig",
    "IsdfError",
    "IsdfMapper",
    "KeyframeConfig",
    "LatticeField",
    "LossConfig",
    "Mapper",
    "MapperConfig",
    "NetworkConfig",
    "NeuralField",
    "NotReadyError",
    "PinholeCamera",
    "Rates",
    "SamplingConfig",
    "Snapshot",
    "SourceError",
    "bake",
    "load_map",
    "plot_slice",
    "query",
]
