"""Depth images on a ROS 2 topic, with poses from tf or from a function; needs rclpy, which a ROS 2 installation has."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

from ..datasets.poses import from_quaternions
from ..datasets.ros_messages import camera_from_info, decode_depth, header_time
from ..datasets.ros_poses import position_and_quaternion
from ..errors import DatasetError, SourceError
from ..frames import DepthFrame
from .live import LiveSource, PoseLookup

INSTALL = "needs rclpy, sensor_msgs and tf2_ros; source a ROS 2 installation (setup.bash) in this shell"
# Longest turn of the executor [s]: how soon iterating notices that the source was closed.
TURN = 0.05


class Ros2Source(LiveSource):
    """Depth images of a ROS 2 topic: 16UC1 [mm], 32FC1 [m], or 16UC1 compressedDepth.

    Poses are tf's: of the image's frame_id in `world_frame` at the image's stamp, for which an image waits up to
    `patience`. Where `pose` is given, that is asked instead. Messages are taken in while the source is iterated over;
    it needs no executor of its own.

    Args:
        depth_topic: the images; one whose name ends in compressedDepth holds CompressedImages.
        info_topic: their CameraInfo; by default camera_info beside the images.
        world_frame: the map is made in this tf frame; one that does not drift or jump, such as odom.
        pose: T_world_camera at a time, instead of tf.
        patience: an image without a transform for so long [s] is passed over.
        timeout: an image must come within this time [s].

    Raises:
        SourceError: there is no rclpy.
    """

    def __init__(
        self,
        depth_topic: str,
        info_topic: str | None = None,
        world_frame: str = "odom",
        pose: PoseLookup | None = None,
        patience: float = 0.5,
        timeout: float = 10.0,
    ) -> None:
        super().__init__(depth_topic)
        try:
            import rclpy
            import tf2_ros
            from rclpy.qos import qos_profile_sensor_data
            from rclpy.time import Time
            from sensor_msgs.msg import CameraInfo, CompressedImage, Image
        except ImportError as error:
            raise SourceError(f"{depth_topic}: {INSTALL} ({error})") from error
        self._rclpy, self._tf2_ros, self._time = rclpy, tf2_ros, Time
        self._world, self._pose, self._patience, self._timeout = world_frame, pose, patience, timeout
        # The newest image replaces one that still waits: a robot wants to know what is there now.
        self._waiting: deque[tuple[Any, float]] = deque(maxlen=1)
        self._info: Any = None
        self._owns_context = not rclpy.ok()
        if self._owns_context:
            rclpy.init()
        self._node = rclpy.create_node("isdf_source")
        compressed = depth_topic.endswith("compressedDepth")
        self._info_topic = info_topic or depth_topic.rsplit("/", 2 if compressed else 1)[0] + "/camera_info"
        kind = CompressedImage if compressed else Image
        self._node.create_subscription(kind, depth_topic, self._take_image, qos_profile_sensor_data)
        self._node.create_subscription(CameraInfo, self._info_topic, self._take_info, qos_profile_sensor_data)
        self._buffer = None if pose is not None else tf2_ros.Buffer()
        self._listener = None if pose is not None else tf2_ros.TransformListener(self._buffer, self._node)

    def close(self) -> None:
        """Leave the topics; also shut rclpy down where this source started it."""
        if not self.closed:
            super().close()
            self._node.destroy_node()
            if self._owns_context:
                self._rclpy.shutdown()

    def _take_image(self, message: Any) -> None:
        if self._waiting:
            self._skip("overtaken by a newer one")
        self._waiting.append((message, time.monotonic()))

    def _take_info(self, message: Any) -> None:
        if self._info is None:
            self._info = message
            self.camera = camera_from_info(message, "image_rect" in self.name, self._info_topic)

    def _next(self) -> DepthFrame | None:
        begun = time.monotonic()
        while not self.closed:
            self._rclpy.spin_once(self._node, timeout_sec=TURN)
            if self._info is not None and self._waiting:
                message, came = self._waiting[0]
                pose = self._look_up(message)
                if pose is not None or time.monotonic() - came > self._patience:
                    self._waiting.popleft()
                    return self._decode(message, pose)
            elif time.monotonic() - begun > self._timeout:
                missing = self.name if self._info is not None else f"{self.name} or no {self._info_topic}"
                raise SourceError(
                    f"no {missing} within {self._timeout} s; `ros2 topic hz {self.name}` tells whether it is published"
                )
        return None

    def _look_up(self, message: Any) -> Any:
        """T_world_camera when the image was taken, None where it is not known (yet)."""
        if self._pose is not None:
            return self._pose(header_time(message, time.time_ns()))
        assert self._buffer is not None
        stamp = self._time.from_msg(message.header.stamp)
        try:
            found = self._buffer.lookup_transform(self._world, message.header.frame_id, stamp)
        except self._tf2_ros.TransformException:
            return None
        numbers = np.array([position_and_quaternion(found)])
        return from_quaternions(numbers[:, :3], numbers[:, 3:])[0]

    def _decode(self, message: Any, pose: Any) -> DepthFrame | None:
        try:
            depth = decode_depth(message, self.name)
        except DatasetError as error:
            raise SourceError(str(error)) from error
        return self._frame(depth, pose, header_time(message, time.time_ns()))
