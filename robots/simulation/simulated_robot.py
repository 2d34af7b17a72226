"""A URDF robot in the simulator: its joints, their motors, and its state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import pybullet
from jaxtyping import Float

from robots.errors import RobotError
from robots.numbers import refuse_nan
from robots.simulation.articulation import Articulation, Joint, JointVector
from robots.simulation.base import DifferentialDrive, DriveConfig, planar_velocity

BASE_JOINTS = ("base_x", "base_y", "base_yaw")


@runtime_checkable
class GripperModel(Protocol):
    """What the simulator needs to know of a gripper; `robots.model` has one."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints of the fingers."""

    @property
    def open_position(self) -> tuple[float, ...]:
        """Position of each of the joints when open [m | rad]."""

    @property
    def closed_position(self) -> tuple[float, ...]:
        """Position of each of the joints when closed [m | rad]."""

    @property
    def max_force(self) -> float:
        """Largest force of each finger [N]."""


@dataclass(frozen=True)
class MotorConfig:
    """Joint motors: position control through velocity constraints limited in force, as pybullet has them."""

    position_gain: float = 0.2
    """Part of the position error removed in one physics step; 0.2 settles in about 30 ms."""
    default_force: float = 100.0
    """[N | N m] for joints whose URDF gives no effort limit."""
    default_velocity: float = 2.0
    """[m/s | rad/s] for joints whose URDF gives no velocity limit."""
    finger_friction: float = 1.0
    finger_spinning_friction: float = 0.05
    """[m] torsional friction of a finger pad: about the radius of the patch it touches with."""
    finger_stiffness: float = 30000.0
    """[N/m] of a finger pad; soft enough to give a steady grip, 0.7 mm at 20 N."""
    finger_damping: float = 1000.0
    """[N s/m]."""

    def __post_init__(self) -> None:
        refuse_nan(self)


class SimulatedRobot(Articulation):
    """One robot loaded into a physics client; `World.add_robot` makes it.

    Args:
        client: id of the pybullet client.
        urdf_path: URDF whose mesh paths pybullet can resolve.
        joint_names: the controlled joints; `base_x`, `base_y`, `base_yaw`, where present, are driven as a
            differential base, all others by position or velocity.
        q: initial positions of `joint_names` (dof,) [rad | m].
        gripper: joints and limits of the gripper, if there is one.
        head_joints: names of the pan and the tilt joint, if there are any.
        T_world_root: pose (4, 4) of the URDF's root link.
        self_collision: whether the robot's links collide with one another.
        drive: limits of the base.
        motors: gains and friction.

    Raises:
        RobotError: if the URDF cannot be loaded or `q` has the wrong length.
        UnknownJointError: if the URDF has no movable joint of a given name.
    """

    def __init__(
        self,
        client: int,
        urdf_path: str | Path,
        joint_names: Sequence[str],
        q: JointVector,
        *,
        gripper: GripperModel | None = None,
        head_joints: Sequence[str] = (),
        T_world_root: np.ndarray | None = None,
        self_collision: bool = False,
        drive: DriveConfig | None = None,
        motors: MotorConfig | None = None,
    ):
        super().__init__(client, urdf_path, T_world_root, self_collision)
        self.joint_names = tuple(joint_names)
        self.gripper = gripper
        self.head_joints = tuple(head_joints)
        self.motors = motors or MotorConfig()
        self.drive = DifferentialDrive(drive) if set(BASE_JOINTS) <= set(joint_names) else None
        self._fingers = self._finger_spans(gripper) if gripper else {}
        for name in (*self.joint_names, *self._fingers, *self.head_joints):
            self.joint(name)
        self._indices = [self.joint(name).index for name in self.joint_names]
        self._arm = [n for n in self.joint_names if not (self.drive and n in BASE_JOINTS)]
        self.reset(q)
        self._hold_everything()
        if gripper:
            self._prepare_fingers(gripper)

    def reset(self, q: JointVector) -> None:
        """Put the joints at `q` (dof,) [rad | m] at rest, outside of physics, and hold them there.

        Raises:
            RobotError: if `q` has the wrong length or is not finite.
        """
        q = self._checked(q, "q")
        for index, value in zip(self._indices, q, strict=True):
            pybullet.resetJointState(self.body, index, value, 0.0, physicsClientId=self.client)
        self.command_joints(q)
        if self.drive:
            self.drive = DifferentialDrive(self.drive.config)

    def state(self) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
        """Positions [rad | m] and velocities [rad/s | m/s] in the order of `joint_names`."""
        states = pybullet.getJointStates(self.body, self._indices, physicsClientId=self.client)
        return np.array([s[0] for s in states]), np.array([s[1] for s in states])

    def command_joints(self, q: JointVector, qdot: JointVector | None = None) -> None:
        """Drive all controlled joints but the base to `q` (dof,), with feed-forward velocity `qdot` (dof,).

        Entries of the base joints are ignored: the base takes `command_base`. Effort and velocity limits
        are the URDF's.

        Raises:
            RobotError: if a vector has the wrong length or is not finite.
        """
        q = self._checked(q, "q")
        qdot = np.zeros_like(q) if qdot is None else self._checked(qdot, "qdot")
        for name, position, velocity in zip(self.joint_names, q, qdot, strict=True):
            if name in self._arm:
                self._hold(name, position, velocity)

    def command_joint_velocities(self, qdot: JointVector) -> None:
        """Drive all controlled joints but the base with velocities `qdot` (dof,) [rad/s | m/s].

        Raises:
            RobotError: if `qdot` has the wrong length or is not finite.
        """
        for name, velocity in zip(self.joint_names, self._checked(qdot, "qdot"), strict=True):
            if name in self._arm:
                self._set_speed(name, velocity)

    def command_base(self, v: float | int, omega: float | int) -> None:
        """Ask the base for forward speed `v` [m/s] and turning rate `omega` [rad/s].

        Raises:
            RobotError: if the robot has no base joints or a value is not finite.
        """
        if self.drive is None:
            raise RobotError(f"the robot has no base: joint_names must contain {BASE_JOINTS}")
        self.drive.command(v, omega)

    def command_gripper(self, opening: float | int, force: float | int | None = None) -> None:
        """Move the fingers to `opening` in [0 closed, 1 open] with at most `force` [N], by default all of it.

        Raises:
            RobotError: if the robot has no gripper or a value is out of range.
        """
        grip = self.gripper
        if grip is None:
            raise RobotError("the robot has no gripper; give one to add_robot")
        force = grip.max_force if force is None else force
        if not (0 <= opening <= 1 and force >= 0):
            raise RobotError(f"need opening in [0, 1] and force >= 0 [N], got {opening} and {force}")
        for name, (low, high) in self._fingers.items():
            self._hold(name, low + opening * (high - low), 0.0, float(force))

    def command_head(self, pan: float | int, tilt: float | int) -> None:
        """Turn the head to `pan` and `tilt` [rad].

        Raises:
            RobotError: if the robot has no head joints.
        """
        if len(self.head_joints) != 2:
            raise RobotError(f"the head needs a pan and a tilt joint, got {self.head_joints}")
        for name, angle in zip(self.head_joints, (pan, tilt), strict=True):
            self._hold(name, float(np.clip(angle, *self.joint(name).limits)), 0.0)

    def drive_substep(self, dt: float) -> None:
        """Turn the base command into velocities of the base joints for the next physics step of `dt` [s]."""
        if self.drive is None:
            return
        c = self.drive.config
        v, omega = self.drive.advance(dt)
        speeds = planar_velocity(v, omega, self.joint_position("base_yaw"), dt)
        forces = (c.max_force, c.max_force, c.max_torque)
        for name, speed, force in zip(BASE_JOINTS, speeds, forces, strict=True):
            self._set_speed(name, speed, force)

    def ground_links(self) -> list[int]:
        """Indices of the links that move with the base only: chassis, wheels and what is bolted on."""
        if self.drive is None:
            return []
        carried = {self.joint("base_yaw").index}
        for joint in sorted(self.joints.values(), key=lambda j: j.index):
            wheel = joint.kind == pybullet.JOINT_REVOLUTE and np.isinf(joint.limits[1])
            if joint.parent in carried and (wheel or joint.kind == pybullet.JOINT_FIXED):
                carried.add(joint.index)
        return sorted(carried)

    def _checked(self, vector: JointVector, name: str) -> np.ndarray:
        array = np.asarray(vector, dtype=np.float64)
        if array.shape != (len(self.joint_names),) or not np.isfinite(array).all():
            raise RobotError(
                f"{name} must be {len(self.joint_names)} finite numbers, one for each of {self.joint_names}; "
                f"got shape {array.shape}, values {array.tolist()}"
            )
        return array

    def _hold(self, name: str, position: float, velocity: float, force: float | None = None) -> None:
        joint = self.joint(name)
        pybullet.setJointMotorControl2(
            self.body,
            joint.index,
            pybullet.POSITION_CONTROL,
            targetPosition=position,
            targetVelocity=velocity,
            positionGain=self.motors.position_gain,
            velocityGain=1.0,
            force=self._effort(joint) if force is None else force,
            maxVelocity=joint.velocity or self.motors.default_velocity,
            physicsClientId=self.client,
        )

    def _set_speed(self, name: str, speed: float, force: float | None = None) -> None:
        joint = self.joint(name)
        limit = joint.velocity or self.motors.default_velocity
        pybullet.setJointMotorControl2(
            self.body,
            joint.index,
            pybullet.VELOCITY_CONTROL,
            targetVelocity=speed if force is not None else float(np.clip(speed, -limit, limit)),
            force=self._effort(joint) if force is None else force,
            physicsClientId=self.client,
        )

    def _effort(self, joint: Joint) -> float:
        return joint.effort or self.motors.default_force

    def _hold_everything(self) -> None:
        """Hold the joints nobody commands (head, gripper, wheels) where they are."""
        for name, joint in self.joints.items():
            if joint.kind != pybullet.JOINT_FIXED and name not in self.joint_names:
                self._hold(name, self.joint_position(name), 0.0)

    def _finger_spans(self, gripper: GripperModel) -> dict[str, tuple[float, float]]:
        """Closed and open position of the gripper's joints and of the joints that mimic them."""
        closed, opened = gripper.closed_position, gripper.open_position
        spans = dict(zip(gripper.joint_names, zip(closed, opened, strict=True), strict=True))
        for name, (leader, scale, offset) in self.mimics.items():
            if leader in spans and name not in spans:
                low, high = spans[leader]
                spans[name] = (scale * low + offset, scale * high + offset)
        return spans

    def _prepare_fingers(self, gripper: GripperModel) -> None:
        m = self.motors
        for name, (_, opened) in self._fingers.items():
            index = self.joint(name).index
            pybullet.changeDynamics(
                self.body,
                index,
                lateralFriction=m.finger_friction,
                spinningFriction=m.finger_spinning_friction,
                contactStiffness=m.finger_stiffness,
                contactDamping=m.finger_damping,
                frictionAnchor=True,
                physicsClientId=self.client,
            )
            pybullet.resetJointState(self.body, index, opened, physicsClientId=self.client)
        if len(self._fingers) == 2:
            (first, a), (second, b) = self._fingers.items()
            # The gear knows no offset: both fingers must pass zero together.
            if np.isclose(a[0] * b[1], a[1] * b[0]):
                ratio = (a[1] - a[0]) / (b[1] - b[0])
                self._couple(self.joint(first), self.joint(second), ratio, gripper.max_force)
        self.command_gripper(1.0)

    def _couple(self, first: Joint, second: Joint, ratio: float, force: float) -> None:
        """Gear two fingers together: two equal motors alone would let the object slide sideways."""
        gear = pybullet.createConstraint(
            self.body,
            first.index,
            self.body,
            second.index,
            jointType=pybullet.JOINT_GEAR,
            jointAxis=[1, 0, 0],
            parentFramePosition=[0, 0, 0],
            childFramePosition=[0, 0, 0],
            physicsClientId=self.client,
        )
        # The constraint keeps first + gearRatio * second at zero.
        pybullet.changeConstraint(
            gear, gearRatio=-ratio, erp=0.1, maxForce=2 * force, physicsClientId=self.client
        )
