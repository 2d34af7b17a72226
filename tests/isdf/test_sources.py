"""Live cameras: the adapters against stand-ins for their drivers, poses by time, and what they pass over."""

from __future__ import annotations

import sys
import types
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from isdf import BackgroundMapper, DepthFrame, SourceError
from isdf.datasets import RecordedSequence
from isdf.sources import FrameSource, RealSenseSource, Ros2Source
from isdf.voxel import ExactConfig, ExactMapper
from tests.isdf.rooms import furnished_orbit

FRAMES = furnished_orbit(12)
CAMERA = FRAMES[0].camera
START = 1_600_000_000.0
ROOM_SCALE = 0.0005  # [m], of the RealSense's depth values


def truth(index: int) -> np.ndarray:
    return FRAMES[index].T_world_camera.numpy()


def assert_same(frame: DepthFrame, index: int, resolution: float) -> None:
    expected = FRAMES[index]
    assert frame.camera == CAMERA and frame.time == pytest.approx(START + index / 10, abs=1e-3)
    assert torch.allclose(frame.T_world_camera, expected.T_world_camera, atol=1e-6)
    assert (frame.depth - expected.depth).abs().max() <= resolution


class FakeRealSense(types.ModuleType):
    """As much of pyrealsense2 as the adapter touches; the names and units are its own."""

    stream = types.SimpleNamespace(depth="depth")
    format = types.SimpleNamespace(z16="z16")
    timestamp_domain = types.SimpleNamespace(hardware_clock=0, system_time=1, global_time=2)

    def __init__(self, frames: list[int], domain: int = 2, connected: bool = True) -> None:
        super().__init__("pyrealsense2")
        self.left, self.domain, self.connected, self.stopped, self.asked = (
            list(frames),
            domain,
            connected,
            0,
            None,
        )

    def config(self) -> Any:
        def enable_stream(*asked: object) -> None:
            self.asked = asked

        return types.SimpleNamespace(enable_stream=enable_stream, enable_device=lambda serial: None)

    def pipeline(self) -> Any:
        return types.SimpleNamespace(start=self._start, wait_for_frames=self._wait, stop=self._stop)

    def _start(self, config: Any) -> Any:
        if not self.connected:
            raise RuntimeError("No device connected")
        intrinsics = types.SimpleNamespace(
            fx=CAMERA.fx, fy=CAMERA.fy, ppx=CAMERA.cx, ppy=CAMERA.cy, width=CAMERA.width, height=CAMERA.height
        )
        stream = types.SimpleNamespace(get_intrinsics=lambda: intrinsics)
        sensor = types.SimpleNamespace(get_depth_scale=lambda: ROOM_SCALE)
        return types.SimpleNamespace(
            get_device=lambda: types.SimpleNamespace(first_depth_sensor=lambda: sensor),
            get_stream=lambda kind: types.SimpleNamespace(as_video_stream_profile=lambda: stream),
        )

    def _wait(self, milliseconds: int) -> Any:
        if not self.left:
            raise RuntimeError(f"Frame didn't arrive within {milliseconds}")
        index = self.left.pop(0)
        self.buffer = np.rint(FRAMES[index].depth.numpy() / ROOM_SCALE).astype(np.uint16)
        image = types.SimpleNamespace(
            get_data=lambda: self.buffer,
            get_timestamp=lambda: 1000 * (START + index / 10),
            get_frame_timestamp_domain=lambda: self.domain,
        )
        return types.SimpleNamespace(get_depth_frame=lambda: image)

    def _stop(self) -> None:
        self.stopped += 1


def pose_by_time(time: float) -> np.ndarray | None:
    index = round(10 * (time - START))
    return None if index == 3 else truth(index)


def test_a_realsense_gives_posed_metres_until_it_is_unplugged(monkeypatch) -> None:
    fake = FakeRealSense([0, 1, 3, 4])
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    got = []
    with RealSenseSource(pose_by_time, 64, 48, 15) as source:
        assert isinstance(source, FrameSource) and fake.asked == ("depth", 64, 48, "z16", 15)
        with pytest.raises(SourceError, match=r"no image within 5\.0 s .*unplugged"):
            for frame in source:
                got.append(frame)
                fake.buffer[:] = 0  # the driver uses its buffer again
        assert source.skipped == {"no pose": 1} and "1 images skipped" in repr(source)
    for frame, index in zip(got, (0, 1, 4), strict=True):
        assert_same(frame, index, 0.51 * ROOM_SCALE)
    source.close()
    assert fake.stopped == 1 and list(source) == []


def test_a_realsense_on_its_own_clock_is_timed_by_when_images_come(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", FakeRealSense([0], domain=0))
    monkeypatch.setattr("isdf.sources.realsense.time.time", lambda: START + 0.5)
    asked = []
    with RealSenseSource(lambda time: asked.append(time) or truth(0)) as source:
        assert next(iter(source)).time == START + 0.5 == asked[0]


def test_what_keeps_a_realsense_from_starting_is_said(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(SourceError, match=r"isdf-planning\[realsense\]"):
        RealSenseSource(pose_by_time)
    monkeypatch.setitem(sys.modules, "pyrealsense2", FakeRealSense([], connected=False))
    with pytest.raises(SourceError, match=r"No device connected.*rs-enumerate-devices"):
        RealSenseSource(pose_by_time, serial="123")


class FakeRos:
    """As much of rclpy and tf2_ros as the adapter touches; what is published comes one message a turn."""

    class TransformException(Exception):
        """tf2_ros.TransformException."""

    def __init__(self) -> None:
        self.queue: list[tuple[str, Any]] = []
        self.tf_known_from: dict[int, int] = {}
        self.turns = self.shut = self.destroyed = 0
        self.handlers: dict[str, Any] = {}
        self.running = False

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        module = types.ModuleType
        rclpy, qos, clock = module("rclpy"), module("rclpy.qos"), module("rclpy.time")
        rclpy.ok, rclpy.init, rclpy.shutdown = lambda: self.running, self._init, self._shutdown
        rclpy.create_node, rclpy.spin_once = lambda name: self, self._spin_once
        qos.qos_profile_sensor_data = "sensor data"
        clock.Time = types.SimpleNamespace(from_msg=lambda stamp: stamp.sec + 1e-9 * stamp.nanosec)
        messages, tf2_ros = module("sensor_msgs.msg"), module("tf2_ros")
        messages.Image, messages.CompressedImage, messages.CameraInfo = (
            "Image",
            "CompressedImage",
            "CameraInfo",
        )
        tf2_ros.TransformException, tf2_ros.Buffer = self.TransformException, lambda: self
        tf2_ros.TransformListener = lambda buffer, node: None
        for one in (rclpy, qos, clock, messages, tf2_ros):
            monkeypatch.setitem(sys.modules, one.__name__, one)
        monkeypatch.setitem(sys.modules, "sensor_msgs", module("sensor_msgs"))

    def _init(self) -> None:
        self.running = True

    def _shutdown(self) -> None:
        self.running, self.shut = False, self.shut + 1

    def _spin_once(self, node: Any, timeout_sec: float) -> None:
        self.turns += 1
        if self.queue:
            topic, message = self.queue.pop(0)
            self.handlers[topic](message)

    def destroy_node(self) -> None:
        self.destroyed += 1

    def create_subscription(self, kind: str, topic: str, handler: Any, qos: str) -> None:
        assert qos == "sensor data" and kind in ("Image", "CompressedImage", "CameraInfo")
        self.handlers[topic] = handler

    def lookup_transform(self, world: str, frame: str, time: float) -> Any:
        assert world == "odom" and frame == "camera_optical"
        index = round(10 * (time - START))
        if self.turns < self.tf_known_from.get(index, 0):
            raise self.TransformException("extrapolation into the future")
        T = truth(index)
        names = types.SimpleNamespace
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        translation = names(**dict(zip("xyz", T[:3, 3], strict=True)))
        return names(transform=names(translation=translation, rotation=names(x=x, y=y, z=z, w=w)))

    def publish_info(self, topic: str = "/cam/depth/camera_info") -> None:
        c = CAMERA
        K = np.array([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1.0])
        info = types.SimpleNamespace(k=K, p=np.zeros(12), d=np.zeros(5), width=c.width, height=c.height)
        self.queue.append((topic, info))

    def publish(self, index: int, topic: str = "/cam/depth/image_raw", **changed: Any) -> None:
        depth = FRAMES[index].depth.numpy().astype("<f4")
        nanoseconds = round((START + index / 10) * 1e9)
        stamp = types.SimpleNamespace(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        fields = {
            "header": types.SimpleNamespace(stamp=stamp, frame_id="camera_optical"),
            "height": depth.shape[0],
            "width": depth.shape[1],
            "encoding": "32FC1",
            "is_bigendian": 0,
            "step": 4 * depth.shape[1],
            "data": np.frombuffer(depth.tobytes(), np.uint8),
        }
        self.queue.append((topic, types.SimpleNamespace(**fields | changed)))


@pytest.fixture
def ros(monkeypatch) -> FakeRos:
    fake = FakeRos()
    fake.install(monkeypatch)
    return fake


def test_a_topic_gives_frames_posed_by_tf_once_tf_knows(ros) -> None:
    ros.publish_info()
    ros.publish(0)
    ros.tf_known_from[0] = 6  # tf comes a little later than the image
    with Ros2Source("/cam/depth/image_raw", patience=30.0) as source:
        frames = iter(source)
        assert_same(next(frames), 0, 1e-6)
        assert ros.turns == 6
        ros.publish(2)
        assert_same(next(frames), 2, 1e-6)
    assert ros.shut == ros.destroyed == 1 and list(source) == []


def test_images_without_a_transform_are_passed_over_and_old_ones_overtaken(ros) -> None:
    ros.publish_info()
    ros.publish(0)
    ros.tf_known_from[0] = ros.tf_known_from[1] = 10**9
    with Ros2Source("/cam/depth/image_raw", patience=0.0) as source:
        ros.publish(1)
        ros.publish(2)
        assert_same(next(iter(source)), 2, 1e-6)
        assert source.skipped == {"no pose": 2}
    ros.running = True  # another node's context
    with Ros2Source("/cam/depth/image_raw", patience=30.0) as source:
        ros.publish_info()
        for index in (0, 1, 4):
            ros.publish(index)
        assert_same(next(iter(source)), 4, 1e-6)
        assert source.skipped == {"overtaken by a newer one": 2}
    assert ros.running and ros.shut == 1


def test_poses_may_come_from_a_function_instead_of_tf(ros) -> None:
    ros.tf_known_from = dict.fromkeys(range(12), 10**9)
    with Ros2Source("/cam/depth/image_raw", "/other/info", pose=pose_by_time) as source:
        ros.publish_info("/other/info")
        ros.publish(5)
        assert_same(next(iter(source)), 5, 1e-6)


def test_silence_and_nonsense_on_a_topic_are_errors_that_name_it(ros, monkeypatch) -> None:
    silent = Ros2Source("/cam/depth/image_raw", timeout=0.0)
    with pytest.raises(SourceError, match=r"no /cam/depth/image_raw or no /cam/depth/camera_info"):
        next(iter(silent))
    silent.close()
    with Ros2Source("/cam/depth/image_raw") as source:
        ros.publish_info()
        ros.publish(0, encoding="rgb8")
        frames = iter(source)
        with pytest.raises(SourceError, match="'rgb8' is no depth"):
            next(frames)
    with Ros2Source("/cam/depth/image_rect/compressedDepth"):
        assert "/cam/depth/camera_info" in ros.handlers
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(SourceError, match=r"setup\.bash"):
        Ros2Source("/cam/depth/image_raw")


def test_any_source_feeds_a_background_mapper(ros, tmp_path) -> None:
    ros.publish_info()
    for index in range(4):
        ros.publish(index)
    mapper = ExactMapper(ExactConfig(voxel=0.1, truncation=0.3))
    with Ros2Source("/cam/depth/image_raw") as source, BackgroundMapper(mapper, queue_size=9) as background:
        for _, frame in zip(range(4), source, strict=False):
            background.integrate(frame)
        assert background.flush(60.0) and background.snapshot().frames == 4
    assert issubclass(RecordedSequence, FrameSource) and not isinstance(3, FrameSource)
