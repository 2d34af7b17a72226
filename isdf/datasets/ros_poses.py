"""Camera poses from ROS messages: stamped poses, odometry, and the tf tree."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import DatasetError
from .poses import from_quaternions, poses_at

POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def read_pose_topic(
    messages: Iterable[tuple[Any, float]],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 4 4"], str]:
    """Time stamps [s], poses [m] and the tracked frame (empty where the messages do not name one)."""
    stamps, numbers, child = [], [], ""
    for message, stamp in messages:
        stamps.append(stamp)
        numbers.append(position_and_quaternion(message))
        child = getattr(message, "child_frame_id", "").strip("/")
    table = np.array(numbers, dtype=np.float64).reshape(-1, 7)
    return np.array(stamps, dtype=np.float64), from_quaternions(table[:, :3], table[:, 3:]), child


class TransformTree:
    """Transforms between named frames over time, as tf keeps them: every frame has at most one parent."""

    def __init__(self) -> None:
        self._edges: dict[str, list[tuple[str, bool, float, tuple[float, ...]]]] = {}

    def __bool__(self) -> bool:
        return bool(self._edges)

    def add(self, message: Any, static: bool) -> None:
        """Take in one TFMessage."""
        for t in message.transforms:
            stamp = t.header.stamp.sec + 1e-9 * t.header.stamp.nanosec
            edge = (t.header.frame_id.strip("/"), static, stamp, position_and_quaternion(t))
            self._edges.setdefault(t.child_frame_id.strip("/"), []).append(edge)

    def poses(
        self, frame: str, world: str | None, times: Float[np.ndarray, "n"], tolerance: float, source: str
    ) -> Float[np.ndarray, "n 4 4"]:
        """T_world_frame [m] at given times [s], interpolated in every link of the chain.

        NaN before the first or after the last transform of a link by more than `tolerance` [s]. `world` is the
        root of the tree where None; `source` begins the message of the DatasetError when there is no such chain.
        """
        poses, at = np.broadcast_to(np.eye(4), (len(times), 4, 4)), frame
        passed = [frame]
        while at != world and at in self._edges:
            poses = self._link(at, times, tolerance) @ poses
            at = self._edges[at][-1][0]
            if at in passed:
                raise DatasetError(f"{source} turns in a circle: {' -> '.join([*passed, at])}")
            passed.append(at)
        if (world is not None and at != world) or (world is None and at == frame):
            known = ", ".join(sorted(self._edges)) or "no frames"
            raise DatasetError(f"{source} has no chain from {frame!r} up to {world!r}; it knows {known}")
        return poses

    def _link(
        self, child: str, times: Float[np.ndarray, "n"], tolerance: float
    ) -> Float[np.ndarray, "n 4 4"]:
        parent, static, _, _ = self._edges[child][-1]
        edges = [e for e in self._edges[child] if e[0] == parent]
        table = np.array([e[3] for e in edges]).reshape(-1, 7)
        poses = from_quaternions(table[:, :3], table[:, 3:])
        if static:
            return np.broadcast_to(poses[-1], (len(times), 4, 4))
        stamps = np.array([e[2] for e in edges])
        # Between two transforms tf interpolates however far apart they are; outside it does not guess.
        out = poses_at(times, stamps, poses, np.inf)
        out[(times < stamps.min() - tolerance) | (times > stamps.max() + tolerance)] = np.nan
        return out


def position_and_quaternion(message: Any) -> tuple[float, ...]:
    """(x, y, z, qx, qy, qz, qw) of any of the pose messages."""
    if hasattr(message, "transform"):
        p, q = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        p, q = pose.position, pose.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
