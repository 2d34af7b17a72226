"""Batched forward kinematics of the planned joints only, through pytorch-kinematics."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pytorch_kinematics
import torch
from jaxtyping import Float
from torch import Tensor

from robots.kinematic_tree import Joint, KinematicTree, roll_pitch_yaw


@dataclass(frozen=True)
class Move:
    """A joint that moves a frame: the frame it stands on, its origin (4, 4) there, and what drives it.

    `source` is the column of q, the multiplier and the offset.
    """

    joint: Joint
    parent: int
    origin: np.ndarray
    source: tuple[int, float, float]


class MovingFrames:
    """The rigid bodies that the planned joints move against each other.

    Links joined by fixed or held joints form one body, so that a robot with 40 links and 11 planned
    joints costs 12 transforms a configuration. Frame 0 is the root; every link has a constant place in
    one frame (`place`).
    """

    def __init__(self, tree: KinematicTree, joints: Sequence[str], held: Mapping[str, float]) -> None:
        self.moves: list[Move] = []  # joint i moves frame i + 1
        self._places: dict[str, tuple[int, np.ndarray]] = {tree.root: (0, np.eye(4))}
        robot = ElementTree.Element("robot", name="moving_frames")
        ElementTree.SubElement(robot, "link", name="frame_0")
        for joint in tree.joints:
            frame, offset = self._places[joint.parent]
            source = _source_of(joint, tree, joints)
            if source is None:
                motion = joint.motion(tree.value_of(joint, held))
                self._places[joint.child] = (frame, offset @ joint.origin @ motion)
                continue
            self.moves.append(Move(joint, frame, offset @ joint.origin, source))
            self._places[joint.child] = (len(self.moves), np.eye(4))
            _append_joint(robot, joint, frame, len(self.moves), offset @ joint.origin)
        self._urdf = ElementTree.tostring(robot, encoding="unicode")
        self._compiled: dict[tuple[torch.dtype, torch.device], tuple[pytorch_kinematics.Chain, ...]] = {}

    def place(self, link: str) -> tuple[int, np.ndarray]:
        """Index of the frame that carries a link and the link's constant pose (4, 4) in it."""
        return self._places[link]

    def __call__(self, q: Float[Tensor, "batch dof"]) -> Float[Tensor, "frames batch 4 4"]:
        """Poses T_root_frame of all frames at configurations q; the backward pass is the geometric Jacobian."""
        chain, order, column, multiplier, offset = self._compile(q)
        values = q.index_select(-1, column) * multiplier + offset
        return chain.forward_kinematics_tensor(values).index_select(0, order)

    def _compile(self, q: Tensor) -> tuple:
        key = (q.dtype, q.device)
        if key not in self._compiled:
            chain = pytorch_kinematics.build_chain_from_urdf(self._urdf).to(dtype=q.dtype, device=q.device)
            numbers = [int(name.removeprefix("joint_")) for name in chain.get_joint_parameter_names()]
            column, multiplier, offset = zip(
                *(self.moves[number - 1].source for number in numbers), strict=True
            )
            frames = [chain.frame_to_idx[f"frame_{i}"] for i in range(len(self.moves) + 1)]
            self._compiled[key] = (
                chain,
                torch.tensor(frames, device=q.device),
                torch.tensor(column, device=q.device),
                torch.tensor(multiplier).to(q),
                torch.tensor(offset).to(q),
            )
        return self._compiled[key]


def _source_of(joint: Joint, tree: KinematicTree, planned: Sequence[str]) -> tuple[int, float, float] | None:
    """Column of q, multiplier and offset that drive a joint; None where it is fixed or held."""
    multiplier, offset = 1.0, 0.0
    while joint.mimic is not None:
        offset += multiplier * joint.mimic.offset
        multiplier *= joint.mimic.multiplier
        joint = tree.joint(joint.mimic.joint)
    if joint.name not in planned:
        return None
    return list(planned).index(joint.name), multiplier, offset


def _append_joint(
    robot: ElementTree.Element, joint: Joint, parent: int, child: int, origin: np.ndarray
) -> None:
    ElementTree.SubElement(robot, "link", name=f"frame_{child}")
    kind = "prismatic" if joint.kind == "prismatic" else "continuous"
    element = ElementTree.SubElement(robot, "joint", name=f"joint_{child}", type=kind)
    xyz, rpy = (" ".join(map(repr, map(float, v))) for v in (origin[:3, 3], roll_pitch_yaw(origin[:3, :3])))
    ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)
    ElementTree.SubElement(element, "parent", link=f"frame_{parent}")
    ElementTree.SubElement(element, "child", link=f"frame_{child}")
    ElementTree.SubElement(element, "axis", xyz=" ".join(map(repr, map(float, joint.axis))))
    ElementTree.SubElement(element, "limit", lower="-1", upper="1", effort="1", velocity="1")
