"""Live cameras: `for frame in source` gives posed depth images as they come, ready for a mapper."""

from .live import FrameSource, LiveSource, PoseLookup
from .realsense import RealSenseSource
from .ros2 import Ros2Source

__all__ = ["FrameSource", "LiveSource", "PoseLookup", "RealSenseSource", "Ros2Source"]
