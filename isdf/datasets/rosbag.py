"""Depth sequences in ROS 1 and ROS 2 bags, read by the rosbags package without a ROS installation."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..camera import PinholeCamera
from ..errors import DatasetError
from ..frames import DepthFrame
from .poses import poses_at
from .ros_messages import SCALES, camera_from_info, decode_depth, header_time
from .ros_poses import POSE_TYPES, TF_TYPES, TransformTree, read_pose_topic
from .sequence import frame_clock

IMAGE, COMPRESSED, CAMERA_INFO = (f"sensor_msgs/msg/{n}" for n in ("Image", "CompressedImage", "CameraInfo"))
SUFFIXES = (".bag", ".mcap", ".db3")
INSTALL = "reading ROS bags needs the rosbags package: pip install 'isdf-planning[readers]'"


class RosbagSequence:
    """Depth images of a ROS bag, with the camera's pose from a pose topic or from tf.

    A topic that is not named is found where the bag has one candidate. Poses are interpolated at the images'
    header stamps. Opening reads the bag once; images are then read one by one. Intrinsics are K of the first
    camera_info, or its P where the depth topic's name says it is rectified.

    Args:
        path: a ROS 1 .bag file, a ROS 2 bag's folder (with metadata.yaml), or a single .mcap or .db3 file of one.
        fps: frames a second; by default from the time stamps.
        depth_topic: 16UC1 [mm], 32FC1 [m] or 16UC1 compressedDepth images.
        info_topic: their CameraInfo; by default camera_info beside the depth topic.
        pose_topic: Pose(WithCovariance)Stamped, Odometry or TransformStamped. A child frame that is not the
            camera's is joined to it by tf; a pose without child frame is the camera's own.
        world_frame: take poses from tf, in this frame; by default only where no pose topic exists, in tf's root.
        T_body_camera: (4, 4) from camera (OpenCV axes) to what the pose topic tracks [m]; overrules tf.
        tolerance: poses may be this far from an image in time [s]; images further away have none.

    Raises:
        DatasetError: rosbags is not installed, or a topic, a transform or a pose is missing or ambiguous.
    """

    layout = "ROS bag"

    def __init__(
        self,
        path: str | Path,
        fps: float | None = None,
        depth_topic: str | None = None,
        info_topic: str | None = None,
        pose_topic: str | None = None,
        world_frame: str | None = None,
        T_body_camera: Float[np.ndarray, "4 4"] | None = None,
        tolerance: float = 0.1,
    ) -> None:
        self.folder = Path(path)
        self._reader = _open_reader(self.folder)
        self.close = weakref.finalize(self, self._reader.close)
        self.depth_topic = depth_topic or self._only_depth_topic()
        self._connections = self._of_topic(self.depth_topic, (IMAGE, COMPRESSED))
        self.camera = self._read_camera(info_topic)
        # Bag time finds the message again; the header's stamp is when the picture was taken.
        self._places: list[tuple[int, int]] = []
        stamps, frame = [], ""
        for bag_time, message in self._messages(self._connections):
            again = bool(self._places) and self._places[-1][0] == bag_time
            self._places.append((bag_time, self._places[-1][1] + 1 if again else 0))
            stamps.append(header_time(message, bag_time))
            frame = message.header.frame_id.strip("/")
        if not stamps:
            raise DatasetError(f"{self.folder}: no images on {self.depth_topic}")
        times = np.array(stamps)
        self.poses = self._read_poses(times, frame, pose_topic, world_frame, T_body_camera, tolerance)
        if not np.isfinite(self.poses).any():
            raise DatasetError(
                f"{self.folder}: no depth image has a pose within {tolerance} s of its time stamp"
            )
        self.fps, self.times = frame_clock(len(times), fps, times)

    @staticmethod
    def missing(folder: Path) -> list[str]:
        """What keeps a path from being a bag; empty when it is one."""
        is_bag = folder.suffix in SUFFIXES if folder.is_file() else (folder / "metadata.yaml").is_file()
        return [] if is_bag else [f"a {', '.join(SUFFIXES)} file, or a folder with metadata.yaml"]

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[DepthFrame]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> DepthFrame:
        """Frame i, its time counted from the first.

        Raises:
            DatasetError: its image cannot be decoded.
            FrameError: its pixels or its pose cannot be used.
        """
        bag_time, place = self._places[i]
        found = self._messages(self._connections, start=bag_time, stop=bag_time + 1)
        message = [m for _, m in found][place]
        depth = decode_depth(message, f"{self.folder}: image {i} of {self.depth_topic}")
        return DepthFrame(depth, self.poses[i], self.camera, time=float(self.times[i]))

    def _messages(self, connections: list[Any], **window: int) -> Iterator[tuple[int, Any]]:
        if connections:  # none would mean all to rosbags
            for connection, bag_time, raw in self._reader.messages(connections, **window):
                yield bag_time, self._reader.deserialize(raw, connection.msgtype)

    def _of_type(self, types: tuple[str, ...]) -> list[str]:
        return sorted({c.topic for c in self._reader.connections if c.msgtype in types and c.msgcount})

    def _of_topic(self, topic: str, types: tuple[str, ...]) -> list[Any]:
        found = [c for c in self._reader.connections if c.topic == topic and c.msgtype in types]
        if not found:
            have = ", ".join(self._of_type(types)) or "none"
            kinds = ", ".join(t.split("/")[-1] for t in types)
            raise DatasetError(
                f"{self.folder}: no topic {topic} of type {kinds}; topics of these types: {have}"
            )
        return found

    def _only_depth_topic(self) -> str:
        found = []
        for topic in self._of_type((IMAGE, COMPRESSED)):
            _, first = next(self._messages(self._of_topic(topic, (IMAGE, COMPRESSED))))
            if getattr(first, "encoding", None) in SCALES or "compressedDepth" in getattr(
                first, "format", ""
            ):
                found.append(topic)
        return self._only(found, "depth image topic", "depth_topic=")

    def _only(self, found: list[str], what: str, argument: str) -> str:
        if len(found) != 1:
            have = f"several: {', '.join(found)}" if found else "none"
            raise DatasetError(f"{self.folder}: expected one {what}, found {have}; pass {argument}")
        return found[0]

    def _read_camera(self, topic: str | None) -> PinholeCamera:
        infos = self._of_type((CAMERA_INFO,))
        if topic is None:
            parents = [self.depth_topic.rsplit("/", n)[0] + "/camera_info" for n in (1, 2)]
            beside = [p for p in parents if p in infos]
            topic = beside[0] if beside else self._only(infos, "CameraInfo topic", "info_topic=")
        _, info = next(self._messages(self._of_topic(topic, (CAMERA_INFO,))), (0, None))
        if info is None:
            raise DatasetError(f"{self.folder}: no message on {topic}")
        return camera_from_info(info, "image_rect" in self.depth_topic, f"{self.folder}: {topic}")

    def _read_poses(
        self,
        times: Float[np.ndarray, "n"],
        frame: str,
        topic: str | None,
        world: str | None,
        T_body_camera: Float[np.ndarray, "4 4"] | None,
        tolerance: float,
    ) -> Float[np.ndarray, "n 4 4"]:
        tf = TransformTree()
        for connection in (c for c in self._reader.connections if c.msgtype in TF_TYPES):
            for _, message in self._messages([connection]):
                tf.add(message, static=connection.topic.endswith("tf_static"))
        candidates = self._of_type(POSE_TYPES)
        if topic is None and (world is not None or (not candidates and tf)):
            return tf.poses(frame, world, times, tolerance, f"{self.folder}: tf")
        topic = topic or self._only(candidates, "pose topic", "pose_topic= (or world_frame= to use tf)")
        messages = self._messages(self._of_topic(topic, POSE_TYPES))
        stamps, measured, child = read_pose_topic((m, header_time(m, t)) for t, m in messages)
        poses = poses_at(times, stamps, measured, tolerance)
        if T_body_camera is not None:
            return poses @ np.asarray(T_body_camera, dtype=np.float64)
        if child in ("", frame):
            return poses
        source = f"{self.folder}: {topic} tracks {child!r}, the images are from {frame!r}; without T_body_camera, tf"
        return poses @ tf.poses(frame, child, times, tolerance, source)


def _open_reader(path: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise DatasetError(f"{path}: {INSTALL}") from error
    # ROS 2 before Iron kept no definitions in sqlite3 bags; those of these messages never changed.
    store = get_typestore(Stores.ROS2_HUMBLE)
    try:
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    except (AnyReaderError, OSError, AssertionError) as error:
        raise DatasetError(f"{path}: not a readable ROS bag ({error})") from error
    return reader
