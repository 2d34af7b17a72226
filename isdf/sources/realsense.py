"""Intel RealSense depth cameras, by way of the pyrealsense2 package."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ..camera import PinholeCamera
from ..errors import SourceError
from ..frames import DepthFrame
from .live import LiveSource, PoseLookup

INSTALL = "RealSense cameras need the pyrealsense2 package: pip install 'isdf-planning[realsense]'"


class RealSenseSource(LiveSource):
    """Depth images of a RealSense camera.

    The camera knows depth, not where it is: `pose` is asked for the pose of the depth imager (the left infrared one)
    at every image's time. On an arm that is forward kinematics, else a tracker or visual odometry; for a camera that
    does not move, `lambda time: T_world_camera`.

    Args:
        pose: where the camera was at a time; images without a pose are passed over.
        width: of the depth stream [pixels].
        height: of the depth stream [pixels].
        fps: of the depth stream.
        serial: of the camera, where several are connected.
        timeout: an image must come within this time [s].

    Raises:
        SourceError: pyrealsense2 is not installed, no such camera is connected, or it has no such stream.
    """

    def __init__(
        self,
        pose: PoseLookup,
        width: int = 640,
        height: int = 480,
        fps: int = 30,
        serial: str | None = None,
        timeout: float = 5.0,
    ) -> None:
        super().__init__(f"RealSense {serial or ''}".strip())
        try:
            import pyrealsense2 as rs
        except ImportError as error:
            raise SourceError(f"{self.name}: {INSTALL} ({error})") from error
        self._rs, self._pose, self._timeout = rs, pose, timeout
        self._pipeline, config = rs.pipeline(), rs.config()
        if serial is not None:
            config.enable_device(serial)
        config.enable_stream(rs.stream.depth, width, height, rs.format.z16, fps)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise SourceError(
                f"{self.name}: no depth stream of {width} x {height} at {fps} Hz ({error}); is the camera connected, "
                "on USB 3, and does it offer this size? rs-enumerate-devices lists them"
            ) from error
        self._metres = float(profile.get_device().first_depth_sensor().get_depth_scale())
        stream = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
        self.camera = PinholeCamera(stream.fx, stream.fy, stream.ppx, stream.ppy, stream.width, stream.height)

    def close(self) -> None:
        """Stop the stream."""
        if not self.closed:
            super().close()
            self._pipeline.stop()

    def _next(self) -> DepthFrame | None:
        try:
            image: Any = self._pipeline.wait_for_frames(round(1000 * self._timeout)).get_depth_frame()
        except RuntimeError as error:
            raise SourceError(
                f"{self.name}: no image within {self._timeout} s ({error}); was the camera unplugged?"
            ) from error
        taken = self._taken(image)
        # The buffer is the driver's: what is made of it must be a copy.
        depth = np.asarray(image.get_data()).astype(np.float32) * np.float32(self._metres)
        return self._frame(depth, self._pose(taken), taken)

    def _taken(self, image: Any) -> float:
        """When the image was taken [s since the epoch]; when it came, where the camera only knows its own clock."""
        own_clock = image.get_frame_timestamp_domain() == self._rs.timestamp_domain.hardware_clock
        return time.time() if own_clock else 1e-3 * float(image.get_timestamp())
