"""A jointed URDF body loaded into a physics client: its joints and links by name, and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias
from xml.etree import ElementTree

import numpy as np
import pybullet
from jaxtyping import Float
from torch import Tensor

from robots.errors import RobotError, UnknownJointError, UnknownLinkError
from robots.simulation.poses import link_frames, split_pose

JointVector: TypeAlias = Sequence[float | int] | np.ndarray | Tensor
"""One number for each controlled joint [rad | m] or [rad/s | m/s]."""


@dataclass(frozen=True)
class Joint:
    """A joint as the URDF gives it, and the link it moves.

    Attributes:
        index: pybullet's index of the joint and of the link it moves.
        link: name of that link.
        parent: index of the link it hangs on, -1 for the root link.
        kind: pybullet's joint type.
        limits: lower and upper position [rad | m], infinite where unlimited.
        effort: largest motor force [N | N m], 0 if the URDF gives none.
        velocity: largest speed [rad/s | m/s], 0 if the URDF gives none.
    """

    index: int
    link: str
    parent: int
    kind: int
    limits: tuple[float, float]
    effort: float
    velocity: float


class Articulation:
    """A URDF body with a fixed root.

    Args:
        client: id of the pybullet client.
        urdf_path: URDF whose mesh paths pybullet can resolve.
        T_world_root: pose (4, 4) of the root link; the world's origin if None.
        self_collision: whether its links collide with one another.

    Raises:
        RobotError: if the file is missing or pybullet cannot load it.
    """

    def __init__(
        self,
        client: int,
        urdf_path: str | Path,
        T_world_root: np.ndarray | None = None,
        self_collision: bool = False,
    ):
        self.client = client
        self.body = self._load(Path(urdf_path), T_world_root, self_collision)
        self.joints = self._read_joints()
        root = pybullet.getBodyInfo(self.body, physicsClientId=client)[0].decode()
        self.link_index = {root: -1} | {j.link: j.index for j in self.joints.values()}
        self.link_names = {index: name for name, index in self.link_index.items()}
        tree = ElementTree.parse(urdf_path).getroot()
        self.mimics = _read_mimics(tree)
        """By joint that mimics another: that other joint, the multiplier and the offset."""
        self._lighten_frames(tree)
        self._remove_passive_damping()

    def joint(self, name: str) -> Joint:
        """Return the movable joint of a name.

        Raises:
            UnknownJointError: if the URDF has no such joint, or a fixed one.
        """
        joint = self.joints.get(name)
        if joint is None or joint.kind == pybullet.JOINT_FIXED:
            movable = sorted(n for n, j in self.joints.items() if j.kind != pybullet.JOINT_FIXED)
            raise UnknownJointError(f"no movable joint {name!r}; the URDF has {movable}")
        return joint

    def joint_position(self, name: str) -> float:
        """Position [rad | m] of any joint of the URDF.

        Raises:
            UnknownJointError: if there is no such joint.
        """
        index = self.joint(name).index
        return float(pybullet.getJointState(self.body, index, physicsClientId=self.client)[0])

    def link_pose(self, link: str) -> Float[np.ndarray, "4 4"]:
        """Pose T_world_link of a link's URDF frame [m].

        Raises:
            UnknownLinkError: if the robot has no such link.
        """
        return self.link_poses([link])[0]

    def link_poses(self, links: Sequence[str]) -> Float[np.ndarray, "n 4 4"]:
        """Poses T_world_link of several links' URDF frames [m].

        Raises:
            UnknownLinkError: if the robot has no link of one of the names.
        """
        return link_frames(self.client, self.body, [self._link(link) for link in links])

    def rigid_group(self, link: str) -> set[str]:
        """Names of all links fixed to a link, itself included.

        Raises:
            UnknownLinkError: if the robot has no such link.
        """
        root = {-1: -1}
        for joint in sorted(self.joints.values(), key=lambda j: j.index):
            fixed = joint.kind == pybullet.JOINT_FIXED
            root[joint.index] = root[joint.parent] if fixed else joint.index
        wanted = root[self._link(link)]
        return {name for index, name in self.link_names.items() if root[index] == wanted}

    def _link(self, name: str) -> int:
        if name not in self.link_index:
            raise UnknownLinkError(f"no link {name!r}; the robot has {sorted(self.link_index)}")
        return self.link_index[name]

    def _load(self, path: Path, T_world_root: np.ndarray | None, self_collision: bool) -> int:
        if not path.is_file():
            raise RobotError(f"no URDF at {path}; give the path of a .urdf file")
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        if self_collision:
            flags |= pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
        position, quaternion = split_pose(np.eye(4) if T_world_root is None else T_world_root)
        try:
            return pybullet.loadURDF(
                str(path), position, quaternion, useFixedBase=True, flags=flags, physicsClientId=self.client
            )
        except pybullet.error as error:
            raise RobotError(f"pybullet cannot load {path}: {error}; check its mesh paths") from error

    def _read_joints(self) -> dict[str, Joint]:
        joints = {}
        for index in range(pybullet.getNumJoints(self.body, physicsClientId=self.client)):
            info = pybullet.getJointInfo(self.body, index, physicsClientId=self.client)
            joints[info[1].decode()] = Joint(
                index=index,
                link=info[12].decode(),
                parent=info[16],
                kind=info[2],
                # pybullet marks a continuous joint by a lower limit above the upper one.
                limits=(info[8], info[9]) if info[8] < info[9] else (-np.inf, np.inf),
                effort=max(0.0, info[10]),
                velocity=max(0.0, info[11]),
            )
        return joints

    def _lighten_frames(self, tree: ElementTree.Element) -> None:
        """Take the weight off links without inertia, which pybullet makes 1 kg with 1 kg m^2."""
        for link in tree.findall("link"):
            index = self.link_index.get(link.get("name", ""), -1)
            if link.find("inertial") is None and index >= 0:
                pybullet.changeDynamics(
                    self.body,
                    index,
                    mass=1e-3,
                    localInertiaDiagonal=[1e-6] * 3,
                    physicsClientId=self.client,
                )

    def _remove_passive_damping(self) -> None:
        """Leave friction to the motors: explicit joint damping is unstable on light links."""
        for index in range(-1, len(self.joints)):
            pybullet.changeDynamics(
                self.body,
                index,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                physicsClientId=self.client,
            )


def _read_mimics(tree: ElementTree.Element) -> dict[str, tuple[str, float, float]]:
    """Read the mimic tags of a URDF, which pybullet leaves out."""
    mimics = {}
    for joint in tree.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            scale, offset = float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))
            mimics[joint.get("name", "")] = (mimic.get("joint", ""), scale, offset)
    return mimics
