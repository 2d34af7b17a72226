"""Arm motions of a parked mobile manipulator: grasp candidates, plans through the map, straight lines, execution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import planning
import robots
from examples.disturbances import DisturbedRobot
from planning.grasping import GraspConfig, Grasps
from planning.hand_room import ParallelHand
from planning.protocols import DistanceField
from planning.validation import check
from planning.workspace import Workspace
from robots.fine_cover import fine_cover
from robots.inverse_kinematics import solve
from robots.simulation import SimulatedMobileRobot

BASE = ("base_x", "base_y", "base_yaw")
CONTROL_PERIOD = 0.02
# The share of the URDF's speed limits the arm uses, and its accelerations [rad/s^2 | m/s^2].
SPEED_SHARE, ACCELERATION = 0.4, 1.0
HAND = ("panda_hand", "panda_leftfinger", "panda_rightfinger")
MOVED = 0.001
"""Balls of the robot that move less than this [m] stand where they stood before."""
ARM_ROOM = 0.015
"""Of what moves of arm and torso on the straight lines [m]; the hand's is judged in the finer map."""


@dataclass(frozen=True)
class Grasp:
    """One way to take an object: postures (dof,) before it, at it and lifted, along straight lines."""

    approach: Tensor
    """(k, dof), from the pre-grasp posture to the grasp."""
    lift: Tensor
    """(k, dof), from the grasp upwards."""


def open_hand(model: robots.Robot) -> ParallelHand:
    """The hand with its fingers open, covered by fine balls."""
    assert model.gripper is not None and model.tool_link is not None
    cover = fine_cover(model.urdf_path)
    links = [link for link in cover if link in HAND]
    tool, *poses = model.link_poses(model.rest, [model.tool_link, *links])
    centres, radii = [], []
    for link, pose in zip(links, poses, strict=True):
        balls = torch.as_tensor(cover[link], dtype=torch.float32)
        T = torch.linalg.inv(tool) @ pose
        centres.append(balls[:, :3] @ T[:3, :3].T + T[:3, 3])
        radii.append(balls[:, 3])
    at, size = torch.cat(centres), torch.cat(radii)
    opening = 2 * (model.gripper.open_position[0] - model.gripper.closed_position[0])
    return ParallelHand(at, size, opening, float((at[:, 2] + size).max()))


def reachable_grasps(
    model: robots.Robot,
    q: Tensor,
    grasps: Grasps,
    field: DistanceField,
    retreat: float = GraspConfig.retreat,
    rise: float = 0.14,
    seed: int = 0,
) -> Iterator[Grasp]:
    """Of ranked grasps those that the arm reaches along a straight line and lifts from, without touching anything.

    Args:
        model: the parked robot: only the arm's and the torso's joints.
        q: its posture now (dof,).
        grasps: the best first.
        field: the map.
        retreat: how far before the grasp the straight approach begins [m].
        rise: how far the object is lifted [m].
        seed: of the inverse kinematics.
    """
    arm = torch.tensor([link not in HAND for link in model.sphere_links])
    for block in torch.arange(len(grasps)).split(8):
        tools = grasps.T_world_tool[block]
        before = tools.clone()
        before[:, :3, 3] -= retreat * tools[:, :3, 2]
        ends = solve(model, before, q, num_seeds=32, seed=seed)
        for i in range(len(block)):
            if not bool(ends.converged[i]):
                continue
            approach = straight_line(model, ends.q[i], before[i], tools[i])
            if approach is None:
                continue
            above = tools[i].clone()
            above[2, 3] += rise
            lift = straight_line(model, approach[-1], tools[i], above)
            if lift is None:
                continue
            ways = torch.cat([approach, lift])
            moved = (model.spheres(ways)[0] - model.spheres(q)[0]).norm(dim=-1).amax(dim=0) > MOVED
            if clearance(model, ways, field, arm & moved) < ARM_ROOM:
                continue
            before_it = planning.Trajectory.through(approach[:1])
            if check(model, before_it, field).status is planning.Status.SUCCESS:
                yield Grasp(approach, lift)


def straight_line(
    model: robots.Robot, q: Tensor, start: Tensor, end: Tensor, steps: int = 8
) -> Tensor | None:
    """Postures (steps + 1, dof) that move the tool along a line; None where it leaves the arm's reach or jumps."""
    postures = [q]
    for share in torch.linspace(0, 1, steps + 1)[1:]:
        pose = start.clone()
        pose[:3, 3] = torch.lerp(start[:3, 3], end[:3, 3], share)
        step = solve(model, pose, postures[-1], num_seeds=1)
        if not bool(step.converged[0]) or float((step.q[0] - postures[-1]).abs().max()) > 0.35:
            return None
        postures.append(step.q[0])
    return torch.stack(postures)


def clearance(
    model: robots.Robot, q: Tensor, field: DistanceField, spheres: Tensor | slice = slice(None)
) -> float:
    """Least clearance [m] of postures q (n, dof) in a field, or of some spheres; the floor under the base left out."""
    workspace = Workspace(model, field, eps=1.0)
    return float(workspace.clearance(*model.spheres(q))[:, spheres].amin())


def plan_reach(
    model: robots.Robot, q: Tensor, goal: Tensor, field: DistanceField, margin: float, seed: int = 0
) -> planning.PlanResult:
    """Plan the arm from q to goal with a margin [m] as large as both of them have themselves, at most `margin`."""
    margin = min(margin, clearance(model, torch.stack([q, goal]), field) - 0.005)
    validation = planning.ValidationConfig(margin=margin, max_step=0.02)
    config = planning.PlannerConfig(
        num_waypoints=40,
        chomp=planning.ChompConfig(eps=0.12, max_iterations=150, validation=validation),
        rrt=planning.RrtConfig(margin=margin + 0.005, min_margin=margin, seconds=5.0),
    )
    return planning.Planner(model, config, seed).plan(q, goal, field)


def execute(
    robot: SimulatedMobileRobot | DisturbedRobot, model: robots.Robot, waypoints: Tensor, speed: float = 1.0
) -> None:
    """Move the arm along postures (n, dof) of `model`, the base at rest."""
    limits = speed * SPEED_SHARE * model.velocity_limits
    path = planning.Trajectory.through(waypoints)
    timed = planning.retime(path, limits, speed * ACCELERATION * torch.ones(model.num_dofs))
    columns = [robot.robot.joint_names.index(name) for name in model.joint_names]
    command = robot.posture()
    for t in np.arange(0.0, timed.duration + CONTROL_PERIOD, CONTROL_PERIOD):
        here, ahead = timed.at(float(t)), timed.at(float(t) + CONTROL_PERIOD)
        speed_now = np.zeros_like(command)
        command[columns], speed_now[columns] = ahead, (ahead - here) / CONTROL_PERIOD
        robot.world.command_joints(command, speed_now)
        robot.drive(0.0, 0.0, CONTROL_PERIOD)
    robot.wait(0.5)


def parked(model: robots.Robot, posture: np.ndarray) -> tuple[robots.Robot, Tensor]:
    """The robot with its base held where it is, and the posture of the joints that are left."""
    values = dict(zip(model.joint_names, posture.tolist(), strict=True))
    arm = model.with_fixed({name: values[name] for name in BASE})
    return arm, torch.tensor([values[name] for name in arm.joint_names], dtype=torch.float32)


def within_limits(model: robots.Robot, q: Tensor) -> Tensor:
    """q moved inside the joint limits: motors settle a hair beyond them."""
    low, high = model.joint_limits.to(q).unbind(-1)
    return q.clamp(low + 1e-4, high - 1e-4)
