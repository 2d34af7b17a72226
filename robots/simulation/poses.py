"""Rigid poses as (4, 4) matrices, and their exchange with the simulator's position and quaternion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation


def planar_pose(x: float | int, y: float | int, z: float | int = 0.0, yaw: float | int = 0.0) -> np.ndarray:
    """Pose (4, 4) at (x, y, z) [m] turned about the vertical by `yaw` [rad]."""
    pose = np.eye(4)
    c, s = np.cos(yaw), np.sin(yaw)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = [x, y, z]
    return pose


def looking(eye: Sequence[float] | np.ndarray, forward: Sequence[float] | np.ndarray) -> np.ndarray:
    """T_world_camera (4, 4) of a level camera at `eye` [m] that looks along `forward`; OpenCV axes."""
    ahead = np.asarray(forward, dtype=np.float64) / np.linalg.norm(forward)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.c_[right, np.cross(ahead, right), ahead, eye]
    return pose


def pose_matrix(position: Sequence[float], quaternion: Sequence[float]) -> np.ndarray:
    """Pose (4, 4) from a position [m] and a quaternion (x, y, z, w)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = position
    return pose


def split_pose(pose: np.ndarray) -> tuple[list[float], list[float]]:
    """Position [m] and quaternion (x, y, z, w) of a pose (4, 4)."""
    pose = np.asarray(pose, dtype=np.float64)
    return pose[:3, 3].tolist(), Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()


def link_frames(client: int, body: int, links: Sequence[int]) -> np.ndarray:
    """Poses T_world_link (n, 4, 4) of the URDF frames of pybullet links; -1 is the root link."""
    frames = np.tile(np.eye(4), (len(links), 1, 1))
    moving = [i for i, link in enumerate(links) if link >= 0]
    if moving:
        indices = [links[i] for i in moving]
        states = pybullet.getLinkStates(body, indices, computeForwardKinematics=True, physicsClientId=client)
        frames[moving, :3, 3] = [state[4] for state in states]
        frames[moving, :3, :3] = Rotation.from_quat([state[5] for state in states]).as_matrix()
    if len(moving) < len(links):
        # The pose pybullet gives is that of the centre of mass; the URDF frame lies behind its offset.
        centre = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        inertial = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[3:5]
        root = pose_matrix(*centre) @ inverse_pose(pose_matrix(*inertial))
        frames[[i for i, link in enumerate(links) if link < 0]] = root
    return frames


def inverse_pose(pose: np.ndarray) -> np.ndarray:
    """Inverse of a rigid pose (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
