"""Voxel maps with the interface of `isdf.Mapper`: the exact-distance map and the methods the paper compares with."""

from .exact import ExactConfig, ExactMapper
from .fiesta import FiestaConfig, FiestaMapper
from .kinectfusion import KinectFusionConfig, KinectFusionMapper
from .mapper import VoxelMapper
from .nearest_seed import NearestSeedField
from .tsdf import TsdfConfig, TsdfVolume
from .voxblox import VoxbloxConfig, VoxbloxMapper
from .voxel_field import VoxelField

__all__ = [
    "ExactConfig",
    "ExactMapper",
    "FiestaConfig",
    "FiestaMapper",
    "KinectFusionConfig",
    "KinectFusionMapper",
    "NearestSeedField",
    "TsdfConfig",
    "TsdfVolume",
    "VoxbloxConfig",
    "VoxbloxMapper",
    "VoxelField",
    "VoxelMapper",
]
