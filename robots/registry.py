"""Ready-made robots by name: `load("tiago")`, `load("panda")`, `load("fetch")` and `load("ur5")`.

URDFs and meshes come from installed packages, example-robot-data and for the Fetch fetch-planning, whose
meshes may not be used commercially (CC BY-NC-SA); only spheres fitted to their hulls are kept here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from robots.errors import UnknownRobotError
from robots.gripper import Gripper
from robots.mesh_paths import example_robot_data, installed_file
from robots.model import Robot
from robots.spheres import load_spheres
from robots.urdf import Attachment, PlanarBase, compose, extract_subtree

DATA = Path(__file__).parent / "data"

# The Franka hand's rated continuous grasping force is 70 N.
FRANKA_HAND = Gripper(
    joint_names=("panda_finger_joint1",), open_position=(0.04,), closed_position=(0.0,), max_force=70.0
)


def available() -> tuple[str, ...]:
    """Names that `load` knows."""
    return tuple(sorted(_LOADERS))


def load(name: str) -> Robot:
    """A ready-made robot.

    - `tiago`: mobile manipulator; q = base_x, base_y [m], base_yaw [rad], torso_lift_joint [m] and
      arm_1..7_joint [rad]; the Franka parallel hand on its wrist, a depth camera on its head.
    - `panda`: the fixed arm with its hand open; q = panda_joint1..7 [rad]. MotionBenchMaker's problems open
      the fingers to 0.065 m, beyond the hand's own limit: `with_fixed({"panda_finger_joint1": 0.065})`.
    - `fetch`: lift and arm of the Fetch on a parked base, in MotionBenchMaker's order; q = torso_lift_joint [m],
      shoulder_pan, shoulder_lift, upperarm_roll, elbow_flex, forearm_roll, wrist_flex and wrist_roll_joint [rad].
    - `ur5`: the fixed arm without a hand; q = shoulder_pan, shoulder_lift, elbow, wrist_1..3_joint [rad].

    Raises `UnknownRobotError` listing the names, and `RobotError` telling which package is missing.
    """
    if name not in _LOADERS:
        raise UnknownRobotError(f"no robot is called {name!r}; available: {', '.join(available())}")
    return _LOADERS[name]()


def tiago_urdf() -> Path:
    """Compose TIAGo without a hand, the Franka hand and a planar base into one URDF in the user's cache."""
    data = example_robot_data()
    hand = extract_subtree(data / "panda_description" / "urdf" / "panda.urdf", "panda_hand")
    # The tool flange's x axis points out of the wrist, the hand's z axis along its fingers. The hand's flange
    # ends 2.5 mm behind its origin, the wrist's 5 mm ahead of its own; the rest keeps the hand's wings, which
    # reach 26 mm back on both sides, clear of the last joint.
    mounted = Attachment(
        hand, "wrist_ft_tool_link", "panda_hand", xyz=(0.01, 0.0, 0.0), rpy=(0.0, math.pi / 2, 0.0)
    )
    body = data / "tiago_description" / "robots" / "tiago_no_hand.urdf"
    return compose(body, [mounted], planar_base=PlanarBase(velocity=0.6, yaw_velocity=1.0), name="tiago")


def panda_urdf() -> Path:
    """Franka's Panda with its hand, mesh paths made absolute, in the user's cache."""
    return compose(example_robot_data() / "panda_description" / "urdf" / "panda.urdf", name="panda")


def fetch_urdf() -> Path:
    """The Fetch with lift and arm as fetch-planning ships it, mesh paths made absolute, in the user's cache."""
    path = installed_file("fetch-planning", "resources/robot/fetch/fetch.urdf", extra="fetch")
    return compose(path, name="fetch")


def ur5_urdf() -> Path:
    """Universal Robots' UR5, mesh paths made absolute, in the user's cache."""
    return compose(example_robot_data() / "ur_description" / "urdf" / "ur5_robot.urdf", name="ur5")


def _load_tiago() -> Robot:
    arm = tuple(f"arm_{i}_joint" for i in range(1, 8))
    postures = {"tucked": TIAGO_TUCKED, "ready": TIAGO_READY}
    return Robot.from_urdf(
        tiago_urdf(),
        load_spheres(DATA / "tiago_spheres.yaml"),
        joints=("base_x", "base_y", "base_yaw", "torso_lift_joint", *arm),
        tool_link="panda_hand_tcp",
        gripper=FRANKA_HAND,
        named={
            name: dict(zip(("torso_lift_joint", *arm), values, strict=True))
            for name, values in postures.items()
        },
        rest=dict(zip(("torso_lift_joint", *arm), TIAGO_TUCKED, strict=True)),
        head_joints=("head_1_joint", "head_2_joint"),
        camera_link="xtion_depth_optical_frame",
    )


def _load_panda() -> Robot:
    joints = tuple(f"panda_joint{i}" for i in range(1, 8))
    rest = dict(zip(joints, PANDA_READY, strict=True))
    return Robot.from_urdf(
        panda_urdf(),
        load_spheres(DATA / "panda_spheres.yaml"),
        joints=joints,
        tool_link="panda_hand_tcp",
        gripper=FRANKA_HAND,
        named={"ready": rest},
        rest=rest,
    )


def _load_fetch() -> Robot:
    arm = ("shoulder_pan", "shoulder_lift", "upperarm_roll", "elbow_flex")
    wrist = ("forearm_roll", "wrist_flex", "wrist_roll")
    joints = tuple(f"{joint}_joint" for joint in ("torso_lift", *arm, *wrist))
    rest = dict(zip(joints, FETCH_TUCKED, strict=True))
    return Robot.from_urdf(
        fetch_urdf(),
        load_spheres(DATA / "fetch_spheres.yaml"),
        joints=joints,
        tool_link="gripper_link",
        named={"tucked": rest},
        rest=rest,
    )


def _load_ur5() -> Robot:
    joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    rest = {f"{joint}_joint": value for joint, value in zip(joints, UR5_READY, strict=True)}
    return Robot.from_urdf(
        ur5_urdf(),
        load_spheres(DATA / "ur5_spheres.yaml"),
        joints=tuple(rest),
        tool_link="tool0",
        named={"ready": rest},
        rest=rest,
    )


# Torso [m], then the seven arm joints [rad].
TIAGO_TUCKED = (0.15, 1.95, -1.50, 1.07, 2.29, 0.28, 0.93, 0.98)
TIAGO_READY = (0.25, 2.18, 0.82, 1.34, 1.53, -0.44, 1.08, 0.68)
PANDA_READY = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
FETCH_TUCKED = (0.1, 1.32, 1.4, -0.2, 1.72, 0.0, 1.66, 0.0)
UR5_READY = (0.0, -1.0, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)

_LOADERS: dict[str, Callable[[], Robot]] = {
    "fetch": _load_fetch,
    "panda": _load_panda,
    "tiago": _load_tiago,
    "ur5": _load_ur5,
}
