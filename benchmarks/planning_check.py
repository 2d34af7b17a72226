"""An independent check of planned paths: pybullet's convex hulls among boxes and cylinders.

It shares no code with the planner: other kinematics, other geometry, other collision tests.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient

TOLERANCE = 1e-3  # [m] of penetration
STEP = 0.02  # [rad | m] between interpolated states, in the joint that moves most
GOAL_POSITION, GOAL_ANGLE = 0.01, np.deg2rad(5.0)
LIMIT_TOLERANCE = 1e-4  # [rad | m]; problems' own starts are rounded
RATE_TOLERANCE = 1e-6  # relative, of velocities and accelerations


@dataclass(frozen=True)
class CheckedRobot:
    """What the checker needs to know of a robot.

    Args:
        urdf: with collision meshes.
        tool_link: whose pose the goal is compared by.
        allowed: link pairs that may touch.
        ignored_links: links without a say, such as a base that stands on the floor.
    """

    urdf: Path
    tool_link: str
    allowed: frozenset[frozenset[str]]
    ignored_links: frozenset[str] = frozenset()


class Checker:
    """Judges results of one robot's problems."""

    def __init__(self, robot: CheckedRobot) -> None:
        self.robot = robot
        self._bullet = BulletClient(pybullet.DIRECT)
        self._body = self._bullet.loadURDF(str(robot.urdf), useFixedBase=True)
        self._links, self._joints = {-1: self._base_name()}, {}
        for i in range(self._bullet.getNumJoints(self._body)):
            info = self._bullet.getJointInfo(self._body, i)
            self._links[i] = info[12].decode()
            if info[2] != pybullet.JOINT_FIXED:
                self._joints[info[1].decode()] = (i, info[8], info[9], info[11])
        shaped = [i for i in self._links if self._bullet.getCollisionShapeData(self._body, i)]
        shaped = [i for i in shaped if self._links[i] not in robot.ignored_links]
        self._shaped = shaped
        self._pairs = [
            (a, b)
            for a, b in itertools.combinations(shaped, 2)
            if frozenset((self._links[a], self._links[b])) not in robot.allowed
        ]
        self._solids: list[int] = []

    def judge(self, problem: Mapping[str, Any], waypoints: Sequence[Sequence[float]]) -> str:
        """`ok`, or what is wrong with a path for a problem of the shared file."""
        self.set_scene(problem)
        path = np.asarray(waypoints, float)
        start, goal = np.array(problem["start"], float), np.array(problem["goal"], float)
        if path.ndim != 2 or path.shape[1] != len(start) or not np.isfinite(path).all():
            return "malformed"
        if np.abs(path[0] - start).max() > 1e-6:
            return "start differs"
        if not self._reaches(problem, path[-1], goal):
            return "goal missed"
        for a, b in itertools.pairwise(path):
            count = max(1, int(np.ceil(np.abs(b - a).max() / STEP)))
            for share in np.arange(count) / count:
                if fault := self.state_fault(problem, a + share * (b - a)):
                    return fault
        return self.state_fault(problem, path[-1]) or "ok"

    def feasible(self, problem: Mapping[str, Any]) -> str:
        """`ok`, or why not even the problem's own start or goal passes."""
        self.set_scene(problem)
        for name in ("start", "goal"):
            if fault := self.state_fault(problem, np.array(problem[name], float)):
                return f"{name}: {fault}"
        return "ok"

    def times_fault(
        self,
        problem: Mapping[str, Any],
        waypoints: Sequence[Sequence[float]],
        times: Sequence[float],
        acceleration_time: float,
    ) -> str:
        """Empty, or what is wrong with the times of a path from rest to rest.

        Velocities of the segments keep the URDF's limits; their differences over half the two segments' times keep the
        acceleration that reaches these limits in `acceleration_time` [s].
        """
        path, at = np.asarray(waypoints, float), np.asarray(times, float)
        if at.shape != (len(path),) or not np.isfinite(at).all() or (np.diff(at) <= 0).any() or len(at) < 2:
            return "times malformed"
        limits = np.array([self._joints[name][3] for name in problem["joints"]])
        dt = np.diff(at)[:, None]
        velocity = np.diff(path, axis=0) / dt
        if (np.abs(velocity) > limits * (1 + RATE_TOLERANCE)).any():
            return f"{problem['joints'][int((np.abs(velocity) / limits).max(0).argmax())]} too fast"
        still = np.zeros((1, len(limits)))
        between = np.concatenate([dt[:1], dt[:-1] + dt[1:], dt[-1:]]) / 2
        acceleration = np.abs(np.diff(np.concatenate([still, velocity, still]), axis=0) / between)
        if (acceleration > limits / acceleration_time * (1 + RATE_TOLERANCE)).any():
            return f"{problem['joints'][int((acceleration / limits).max(0).argmax())]} accelerates too hard"
        return ""

    def state_fault(self, problem: Mapping[str, Any], q: np.ndarray) -> str:
        """Empty, or what is wrong with a configuration."""
        for name, value in zip(problem["joints"], q, strict=True):
            _, low, high, _ = self._joints[name]
            if low < high and not low - LIMIT_TOLERANCE <= value <= high + LIMIT_TOLERANCE:
                return f"{name} beyond its limits"
        self._pose(problem, q)
        for solid in self._solids:
            for point in self._bullet.getClosestPoints(self._body, solid, 0.0):
                if point[8] < -TOLERANCE and point[3] in self._shaped:
                    return f"{self._links[point[3]]} in an obstacle"
        for a, b in self._pairs:
            for point in self._bullet.getClosestPoints(self._body, self._body, 0.0, a, b):
                if point[8] < -TOLERANCE:
                    return f"{self._links[a]} in {self._links[b]}"
        return ""

    def set_scene(self, problem: Mapping[str, Any]) -> None:
        """Replace the obstacles."""
        for solid in self._solids:
            self._bullet.removeBody(solid)
        self._solids = []
        for o in problem["obstacles"]:
            if o["type"] == "box":
                half = [d / 2 for d in o["dimensions"]]
                shape = self._bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
            else:
                height, radius = o["dimensions"]
                shape = self._bullet.createCollisionShape(
                    pybullet.GEOM_CYLINDER, radius=radius, height=height
                )
            self._solids.append(
                self._bullet.createMultiBody(
                    0, shape, basePosition=o["position"], baseOrientation=o["quat_xyzw"]
                )
            )

    def _pose(self, problem: Mapping[str, Any], q: np.ndarray) -> None:
        values = {**problem.get("start_all", {}), **dict(zip(problem["joints"], q, strict=True))}
        for name, value in values.items():
            if name in self._joints:
                self._bullet.resetJointState(self._body, self._joints[name][0], value)

    def _reaches(self, problem: Mapping[str, Any], q: np.ndarray, goal: np.ndarray) -> bool:
        poses = []
        tool = next(i for i, name in self._links.items() if name == self.robot.tool_link)
        for state in (q, goal):
            self._pose(problem, state)
            found = self._bullet.getLinkState(self._body, tool, computeForwardKinematics=True)
            poses.append((np.array(found[4]), np.array(found[5])))
        offset = np.linalg.norm(poses[0][0] - poses[1][0])
        angle = 2 * np.arccos(min(1.0, abs(float(poses[0][1] @ poses[1][1]))))
        return bool(offset <= GOAL_POSITION and angle <= GOAL_ANGLE)

    def _base_name(self) -> str:
        return self._bullet.getBodyInfo(self._body)[0].decode()
