"""ROS bags, written here with the rosbags package, read back as depth sequences."""

import builtins
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from isdf import DatasetError, FrameError, PinholeCamera
from isdf.datasets import DepthSequence, RosbagSequence, open_sequence
from tests.isdf.test_readers import CAMERA, assert_reads, make_depths, steady_motion

DEPTH, INFO = "/camera/depth/image_raw", "/camera/depth/camera_info"
OPTICAL = "camera_depth_optical_frame"
START = 1_600_000_000  # [s]
STAMPS = [0.0, 0.1, 0.2]
TRUTH = np.stack([steady_motion(t) for t in STAMPS])
POSE_STAMPS = np.arange(-0.07, 0.3, 0.05)  # never at the images' own times
# Where a base's camera sits: looking along the base's x axis, half a metre up.
T_BASE_CAMERA = np.eye(4)
T_BASE_CAMERA[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
T_BASE_CAMERA[:3, 3] = [0.2, 0.0, 0.5]


class BagWriter:
    """Writes messages of either ROS version; the bag's clock runs 30 ms behind the header stamps."""

    def __init__(self, path: Path, ros2: bool) -> None:
        pytest.importorskip("rosbags")
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros2, self.path = ros2, path if ros2 else path.with_suffix(".bag")
        self.store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
        if not ros2:  # rosbags' Noetic types do not hold tf2_msgs
            tf = get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            self.store.register(tf)
        self.writer: Any = Writer2(self.path, version=9) if ros2 else Writer1(self.path)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> "BagWriter":
        self.writer.open()
        return self

    def __exit__(self, *exception: object) -> None:
        self.writer.close()

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, t: float, frame: str) -> Any:
        nanoseconds = round((START + t) * 1e9)
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        )
        more = {} if self.ros2 else {"seq": 0}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **more)

    def write(self, topic: str, t: float, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_cdr if self.ros2 else self.store.serialize_ros1
        self.writer.write(self.connections[topic], round((START + t + 0.03) * 1e9), serialize(message, kind))

    def image(self, t: float, depth: np.ndarray, encoding: str = "16UC1", topic: str = DEPTH) -> None:
        values = np.rint(depth * 1000).astype("<u2") if encoding == "16UC1" else depth.astype("<f4")
        rows = np.pad(values.view(np.uint8).reshape(len(values), -1), ((0, 0), (0, 8)))  # padded rows
        fields = {"height": len(values), "width": values.shape[1], "encoding": encoding, "is_bigendian": 0}
        header = self.header(t, OPTICAL)
        message = self.make(
            "sensor_msgs/msg/Image", header=header, step=rows.shape[1], data=rows.ravel(), **fields
        )
        self.write(topic, t, message)

    def info(self, topic: str = INFO, camera: PinholeCamera = CAMERA) -> None:
        c = camera
        K = np.array([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1.0])
        P = np.array([c.fx + 1, 0, c.cx, 0, 0, c.fy, c.cy, 0, 0, 0, 1.0, 0])
        matrices = {"D": np.zeros(5), "K": K, "R": np.eye(3).ravel(), "P": P}
        matrices = {k.lower() if self.ros2 else k: v for k, v in matrices.items()}
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        size = {"height": c.height, "width": c.width, "binning_x": 0, "binning_y": 0, "roi": roi}
        header = self.header(0, OPTICAL)
        message = self.make(
            "sensor_msgs/msg/CameraInfo", header=header, distortion_model="plumb_bob", **size, **matrices
        )
        self.write(topic, 0, message)

    def pose(self, T: np.ndarray) -> Any:
        p, q = self.position_and_quaternion(T, "Point")
        return self.make("geometry_msgs/msg/Pose", position=p, orientation=q)

    def position_and_quaternion(self, T: np.ndarray, kind: str) -> tuple[Any, Any]:
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        position = self.make(
            f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, T[:3, 3]), strict=True))
        )
        rotation = dict(zip("xyzw", map(float, q), strict=True))
        return position, self.make("geometry_msgs/msg/Quaternion", **rotation)

    def pose_stamped(self, topic: str, t: float, T: np.ndarray) -> None:
        header = self.header(t, "world")
        self.write(topic, t, self.make("geometry_msgs/msg/PoseStamped", header=header, pose=self.pose(T)))

    def odometry(self, topic: str, t: float, T: np.ndarray, child: str = "base_link") -> None:
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        pose = self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(T), covariance=np.zeros(36))
        twist = self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
        fields = {"child_frame_id": child, "pose": pose, "twist": twist}
        self.write(topic, t, self.make("nav_msgs/msg/Odometry", header=self.header(t, "odom"), **fields))

    def transform(self, topic: str, t: float, T: np.ndarray, parent: str, child: str) -> None:
        p, q = self.position_and_quaternion(T, "Vector3")
        transform = self.make("geometry_msgs/msg/Transform", translation=p, rotation=q)
        header = self.header(t, parent)
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
        )
        self.write(topic, t, self.make("tf2_msgs/msg/TFMessage", transforms=[stamped]))


@pytest.fixture(params=["ros1", "ros2"])
def bag(request, tmp_path) -> BagWriter:
    return BagWriter(tmp_path / "bag", ros2=request.param == "ros2")


def write_images(bag: BagWriter, **options: Any) -> None:
    bag.info()
    for t, depth in zip(STAMPS, make_depths(3), strict=True):
        bag.image(t, depth, **options)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_images_and_a_pose_topic_are_found_and_interpolated(bag, encoding) -> None:
    with bag:
        write_images(bag, encoding=encoding)
        for t in POSE_STAMPS:
            bag.pose_stamped("/slam/pose", t, steady_motion(t))
    sequence = open_sequence(bag.path)
    assert isinstance(sequence, RosbagSequence) and isinstance(sequence, DepthSequence)
    assert sequence.camera == CAMERA and sequence.fps == pytest.approx(10.0, rel=1e-4)
    assert_reads(sequence, make_depths(3), TRUTH)
    assert [f.time for f in sequence] == pytest.approx(STAMPS, abs=1e-6)
    assert RosbagSequence(bag.path, fps=5.0)[1].time == pytest.approx(0.2)


@pytest.mark.parametrize("kind", ["PoseWithCovarianceStamped", "TransformStamped"])
def test_other_pose_messages(bag, kind) -> None:
    with bag:
        write_images(bag)
        for t in POSE_STAMPS:
            header = bag.header(t, "world")
            if kind == "TransformStamped":
                p, q = bag.position_and_quaternion(steady_motion(t), "Vector3")
                transform = bag.make("geometry_msgs/msg/Transform", translation=p, rotation=q)
                fields = {"transform": transform, "child_frame_id": OPTICAL}
            else:
                pose = bag.pose(steady_motion(t))
                covariance = np.zeros(36)
                fields = {
                    "pose": bag.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
                }
            bag.write("/pose", t, bag.make(f"geometry_msgs/msg/{kind}", header=header, **fields))
    assert_reads(open_sequence(bag.path), make_depths(3), TRUTH)


def test_single_files_of_ros_2_bags_and_two_images_at_one_bag_time(tmp_path) -> None:
    with BagWriter(tmp_path / "bag", ros2=True) as bag:
        write_images(bag)
        for t in POSE_STAMPS:
            bag.pose_stamped("/pose", t, steady_motion(t))
        late = bag.header(0.2, OPTICAL)  # recorded with the image before it, as when a queue is emptied
        values = np.full((CAMERA.height, CAMERA.width), 2500, "<u2").view(np.uint8)
        size = {"height": CAMERA.height, "width": CAMERA.width, "step": 2 * CAMERA.width}
        fields = {"encoding": "mono16", "is_bigendian": 0, "data": values.ravel()}
        bag.write(DEPTH, STAMPS[2], bag.make("sensor_msgs/msg/Image", header=late, **size, **fields))
    sequence = open_sequence(next(bag.path.glob("*.db3")))
    torch.testing.assert_close(
        sequence[2].depth, torch.from_numpy(make_depths(3)[2]).float(), atol=1e-3, rtol=0
    )
    assert len(sequence) == 4 and (sequence[3].depth == 2.5).all()


def test_odometry_of_the_base_is_joined_to_the_camera_by_tf(bag) -> None:
    with bag:
        write_images(bag)
        bag.transform("/tf_static", 0, T_BASE_CAMERA, "base_link", OPTICAL)
        for t in POSE_STAMPS:
            bag.odometry("/odom", t, steady_motion(t))
    assert_reads(open_sequence(bag.path), make_depths(3), TRUTH @ T_BASE_CAMERA)
    other = T_BASE_CAMERA @ T_BASE_CAMERA
    assert_reads(RosbagSequence(bag.path, T_body_camera=other), make_depths(3), TRUTH @ other)


def test_odometry_of_the_base_without_tf_is_refused(bag) -> None:
    with bag:
        write_images(bag)
        for t in POSE_STAMPS:
            bag.odometry("/odom", t, steady_motion(t))
    with pytest.raises(DatasetError, match="tracks 'base_link', the images are from 'camera_depth_optical"):
        open_sequence(bag.path)
    assert_reads(RosbagSequence(bag.path, T_body_camera=T_BASE_CAMERA), make_depths(3), TRUTH @ T_BASE_CAMERA)


def test_poses_from_the_tf_chain(bag) -> None:
    T_map_odom = steady_motion(0.7)
    with bag:
        write_images(bag)
        bag.transform("/tf_static", 0, T_BASE_CAMERA, "base_link", OPTICAL)
        for t in (-0.5, 0.5):  # a slow localiser: tf interpolates over the second between
            bag.transform("/tf", t, T_map_odom, "map", "odom")
        for t in POSE_STAMPS:
            bag.transform("/tf", t, steady_motion(t), "odom", "base_link")
    assert_reads(open_sequence(bag.path), make_depths(3), T_map_odom @ TRUTH @ T_BASE_CAMERA)
    assert_reads(RosbagSequence(bag.path, world_frame="odom"), make_depths(3), TRUTH @ T_BASE_CAMERA)
    with pytest.raises(DatasetError, match=r"no chain from 'camera_depth_optical_frame' up to 'earth'"):
        RosbagSequence(bag.path, world_frame="earth")


def test_an_image_after_the_last_pose_is_refused(bag) -> None:
    with bag:
        write_images(bag)
        for t in POSE_STAMPS[POSE_STAMPS < 0.08]:
            bag.pose_stamped("/pose", t, steady_motion(t))
    sequence = RosbagSequence(bag.path, tolerance=0.08)
    assert np.isfinite(sequence.poses).all(axis=(1, 2)).tolist() == [True, True, False]
    with pytest.raises(FrameError, match="NaN or inf"):
        sequence[2]
    with pytest.raises(DatasetError, match="no depth image has a pose within"):
        RosbagSequence(bag.path, tolerance=1e-6)


def test_compressed_depth_and_rectified_intrinsics(bag) -> None:
    topic = "/camera/depth/image_rect/compressedDepth"
    with bag:
        bag.info()
        for t, depth in zip(STAMPS, make_depths(3), strict=True):
            buffer = BytesIO()
            Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(buffer, "png")
            data = np.frombuffer(bytes(12) + buffer.getvalue(), np.uint8)
            fields = {"format": "16UC1; compressedDepth png", "data": data}
            header = bag.header(t, OPTICAL)
            bag.write(topic, t, bag.make("sensor_msgs/msg/CompressedImage", header=header, **fields))
        for t in POSE_STAMPS:
            bag.pose_stamped("/pose", t, steady_motion(t))
    sequence = open_sequence(bag.path)
    assert sequence.camera.fx == CAMERA.fx + 1  # P's, since the images are rectified
    assert_reads(sequence, make_depths(3), TRUTH)


def test_ambiguous_or_missing_topics_are_named(bag) -> None:
    with bag:
        write_images(bag)
        bag.image(0.0, make_depths(1)[0], topic="/other/depth", encoding="32FC1")
        for topic in ("/a", "/b"):
            bag.pose_stamped(topic, 0.0, TRUTH[0])
    with pytest.raises(
        DatasetError, match=r"several: /camera/depth/image_raw, /other/depth; pass depth_topic="
    ):
        open_sequence(bag.path)
    with pytest.raises(DatasetError, match=r"several: /a, /b; pass pose_topic="):
        RosbagSequence(bag.path, depth_topic=DEPTH)
    with pytest.raises(DatasetError, match=r"no topic /c of type .*: /a, /b"):
        RosbagSequence(bag.path, depth_topic=DEPTH, pose_topic="/c")
    sequence = RosbagSequence(bag.path, depth_topic=DEPTH, pose_topic="/b")
    torch.testing.assert_close(sequence[0].T_world_camera, torch.from_numpy(TRUTH[0]))


def test_a_damaged_bag_is_named(tmp_path) -> None:
    pytest.importorskip("rosbags")
    (tmp_path / "room.bag").write_bytes(b"#ROSBAG V2.0\nnot one")
    with pytest.raises(DatasetError, match=r"room\.bag: not a readable ROS bag"):
        open_sequence(tmp_path / "room.bag")
    (tmp_path / "two").mkdir()
    (tmp_path / "two" / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    with pytest.raises(DatasetError, match="two: not a readable ROS bag"):
        open_sequence(tmp_path / "two")


def test_without_rosbags_the_message_says_how_to_install_it(tmp_path, monkeypatch) -> None:
    (tmp_path / "room.bag").write_bytes(b"")
    original = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("rosbags"):
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(DatasetError, match=r"pip install 'isdf-planning\[readers\]'"):
        open_sequence(tmp_path / "room.bag")
