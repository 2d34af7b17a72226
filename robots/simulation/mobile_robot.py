"""A simulated mobile robot as a closed loop sees a real one: it senses, looks, drives and lets time pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from robots.errors import RobotError
from robots.model import Robot
from robots.self_filter import remove_robot
from robots.simulation.camera import DepthCamera, DepthFrame, PinholeCamera
from robots.simulation.depth_noise import DepthNoise
from robots.simulation.recording import Recording
from robots.simulation.simulated_robot import BASE_JOINTS
from robots.simulation.world import World


class SimulatedMobileRobot:
    """Puts a robot with a planar base and a head camera into a world, and drives it there.

    Args:
        world: without a robot yet.
        robot: with base joints, two head joints and a camera link.
        q: initial posture (dof,), base included.
        camera: intrinsics of the depth camera.
        noise: applied to every depth image; exact images if None.
        seed: of the noise.
        max_range: of the camera [m].
        filter_margin: pixels within this of the robot's spheres are taken for the robot [m].

    Raises:
        RobotError: if the robot lacks a base, a head or a camera.
    """

    def __init__(
        self,
        world: World,
        robot: Robot,
        q: Float[np.ndarray, " dof"],
        *,
        camera: PinholeCamera | None = None,
        noise: DepthNoise | None = None,
        seed: int = 0,
        max_range: float = 5.0,
        filter_margin: float = 0.03,
    ) -> None:
        lacks = [f"the joint {name}" for name in BASE_JOINTS if name not in robot.joint_names]
        lacks += [] if len(robot.head_joints) == 2 else ["two head joints"]
        lacks += [] if robot.camera_link else ["a camera link"]
        if lacks:
            raise RobotError(f"{robot.name!r} cannot drive and look: it lacks {', '.join(lacks)}")
        self.world, self.robot, self.noise = world, robot, noise
        self.filter_margin = filter_margin
        self.simulated = world.add_robot(
            robot.urdf_path, robot.joint_names, q, gripper=robot.gripper, head_joints=robot.head_joints
        )
        self.camera = DepthCamera(world, camera, link=robot.camera_link, max_range=max_range)
        self.recording = Recording(world)
        self._rng = np.random.default_rng(seed)
        self._base = [robot.joint_names.index(name) for name in BASE_JOINTS]

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.world.time

    def base_state(self) -> Float[np.ndarray, "3"]:
        """x, y [m] and yaw [rad] of the base."""
        return self.posture()[self._base]

    def posture(self) -> Float[np.ndarray, " dof"]:
        """Joint positions in the order of the robot's `joint_names`."""
        return self.world.robot_state()[0]

    def observe(self) -> DepthFrame:
        """A depth image now, with noise if configured, from which the robot's own body is removed."""
        frame = self.camera.render()
        depth = frame.depth if self.noise is None else self.noise(frame.depth, self._rng)
        centres, radii = self.robot.spheres(torch.as_tensor(self.posture(), dtype=torch.float32))
        depth = remove_robot(
            depth, frame.camera, frame.T_world_camera, centres, radii, margin=self.filter_margin
        )
        return replace(frame, depth=depth)

    def look_at(self, point: Float[np.ndarray, "3"]) -> None:
        """Turn the head so that the camera faces a world point [m], as far as the head goes."""
        q = torch.as_tensor(self.posture(), dtype=torch.float32)
        ray = np.asarray(point, dtype=np.float64) - self.robot.camera_pose(q, head=(0.0, 0.0))[:3, 3]
        yaw = float(self.base_state()[2])
        pan = np.arctan2(ray[1], ray[0]) - yaw
        pan = (pan + np.pi) % (2 * np.pi) - np.pi
        tilt = np.arctan2(ray[2], np.hypot(ray[0], ray[1]))
        self.world.command_head(float(pan), float(tilt))

    def drive(self, v: float | int, omega: float | int, duration: float | int) -> None:
        """Drive at v [m/s] and omega [rad/s] for `duration` [s] of physics, and record what happened."""
        self.world.command_base(v, omega)
        self.world.step(duration)
        self.recording.add()

    def wait(self, duration: float | int, period: float | int = 0.1) -> None:
        """Let time [s] pass at rest, so that arm, gripper and objects can move; recorded every `period` [s]."""
        for _ in range(max(1, round(duration / period))):
            self.drive(0.0, 0.0, period)
