"""Voxel maps with the interface of `isdf.Mapper`: the exact-distance map and the paper's KinectFusion+."""

from .exact import ExactConfig, ExactMapper
from .kinectfusion import KinectFusionConfig, KinectFusionMapper, OccupancyField
from .mapper import VoxelMapper
from .nearest_seed import NearestSeedField
from .tsdf import TsdfConfig, TsdfVolume

__all__ = [
    "ExactConfig",
    "ExactMapper",
    "KinectFusionConfig",
    "KinectFusionMapper",
    "NearestSeedField",
    "OccupancyField",
    "TsdfConfig",
    "TsdfVolume",
    "VoxelMapper",
]
