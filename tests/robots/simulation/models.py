"""Robots for the simulation's tests: a small mobile cart, and the Panda that comes with pybullet."""

from __future__ import annotations

import pathlib
from dataclasses import dataclass

import pybullet_data

MOBILE = """<?xml version="1.0"?>
<robot name="cart">
  <link name="odom"/>
  {virtual}
  <link name="chassis">{inertia40}
    <visual><origin xyz="0 0 0.15"/><geometry><cylinder radius="0.25" length="0.3"/></geometry></visual>
    <collision><origin xyz="0 0 0.15"/><geometry><cylinder radius="0.25" length="0.3"/></geometry></collision>
  </link>
  <link name="wheel">{inertia1}
    <visual><geometry><sphere radius="0.1"/></geometry></visual>
    <collision><geometry><sphere radius="0.1"/></geometry></collision>
  </link>
  <joint name="wheel_joint" type="continuous">
    <parent link="chassis"/><child link="wheel"/><origin xyz="0 0.2 0.05"/><axis xyz="0 1 0"/>
  </joint>
  <link name="arm">{inertia1}
    <visual><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.06 0.06"/></geometry></visual>
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.06 0.06"/></geometry></collision>
  </link>
  <joint name="shoulder" type="revolute">
    <parent link="chassis"/><child link="arm"/><origin xyz="0.1 0 0.8"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.5" effort="60" velocity="1.5"/>
  </joint>
  <link name="pan">{inertia1}</link>
  <joint name="pan_joint" type="revolute">
    <parent link="chassis"/><child link="pan"/><origin xyz="0 0 1.2"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="10" velocity="3"/>
  </joint>
  <link name="tilt">{inertia1}
    <visual><geometry><box size="0.2 0.2 0.2"/></geometry></visual>
  </link>
  <joint name="tilt_joint" type="revolute">
    <parent link="pan"/><child link="tilt"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="10" velocity="3"/>
  </joint>
  <link name="optical"/>
  <joint name="optical_joint" type="fixed">
    <parent link="tilt"/><child link="optical"/>
    <origin xyz="0 0 0" rpy="-1.57079632679 0 -1.57079632679"/>
  </joint>
</robot>
"""

CART_JOINTS = ("base_x", "base_y", "base_yaw", "shoulder")


def inertia(mass: float, moment: float) -> str:
    return (
        f'<inertial><mass value="{mass}"/><inertia ixx="{moment}" iyy="{moment}" izz="{moment}" '
        'ixy="0" ixz="0" iyz="0"/></inertial>'
    )


@dataclass(frozen=True)
class Hand:
    """The Panda's hand: its second finger mimics the first, as the URDF says."""

    joint_names: tuple[str, ...] = ("panda_finger_joint1",)
    open_position: tuple[float, ...] = (0.04,)
    closed_position: tuple[float, ...] = (0.0,)
    max_force: float = 20.0


PANDA_URDF = str(pathlib.Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf")
PANDA_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
