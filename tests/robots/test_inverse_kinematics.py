"""Inverse kinematics reaches poses that are known to be reachable, within limits, and says so when it cannot."""

from __future__ import annotations

import math

import pytest
import torch

import robots
from robots.inverse_kinematics import _step, solve


@pytest.fixture(scope="module")
def panda() -> robots.Robot:
    return robots.load("panda")


@pytest.fixture(scope="module")
def tiago() -> robots.Robot:
    return robots.load("tiago")


def reachable_targets(robot: robots.Robot, count: int, seed: int) -> torch.Tensor:
    lower, upper = robot.joint_limits.clamp(-2, 2).unbind(-1)
    q = lower + (upper - lower) * torch.rand(
        count, robot.num_dofs, generator=torch.Generator().manual_seed(seed)
    )
    return robot.link_poses(q, [robot.tool_link])[:, 0]


@pytest.mark.parametrize("name", ["panda", "tiago"])
def test_reachable_poses_are_reached(name: str) -> None:
    robot = robots.load(name)
    targets = reachable_targets(robot, 8, seed=0)
    solution = solve(robot, targets, robot.rest)
    assert solution.converged.float().mean() >= 7 / 8
    lower, upper = robot.joint_limits.unbind(-1)
    assert ((solution.q >= lower) & (solution.q <= upper)).all()
    reached = robot.link_poses(solution.q, [robot.tool_link])[:, 0]
    off = (reached[:, :3, 3] - targets[:, :3, 3]).norm(dim=-1)
    torch.testing.assert_close(off, solution.position_error, atol=1e-5, rtol=0)
    cosine = ((reached[:, :3, :3] * targets[:, :3, :3]).sum((-1, -2)) - 1) / 2
    assert (cosine[solution.converged] > math.cos(0.012)).all()


def test_only_the_given_joints_move(tiago: robots.Robot) -> None:
    arm = [name for name in tiago.joint_names if name.startswith("arm")]
    seed = tiago.named["ready"]
    target = tiago.link_poses(seed, [tiago.tool_link])[0].clone()
    target[2, 3] -= 0.05
    solution = solve(tiago, target, seed, joints=arm)
    assert solution.converged.all()
    assert torch.equal(solution.q[0, :4], seed[:4])


def test_works_on_a_robot_with_fixed_joints(tiago: robots.Robot) -> None:
    arm = tiago.with_fixed({"base_x": 1.0, "base_y": 2.0, "base_yaw": 0.5, "torso_lift_joint": 0.2})
    target = arm.link_poses(arm.named["ready"], [arm.tool_link])[0]
    solution = solve(arm, target, arm.rest)
    assert solution.q.shape == (1, 7)
    assert solution.converged.all()


def test_free_axis_lets_the_tool_turn(panda: robots.Robot) -> None:
    target = panda.link_poses(panda.rest, [panda.tool_link])[0]
    turned = target.clone()
    angle = torch.tensor(2.5)
    spin = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1.0]])
    turned[:3, :3] = target[:3, :3] @ spin
    solution = solve(panda, turned, panda.rest, free_axis=2, num_seeds=1)
    assert solution.converged.all()
    torch.testing.assert_close(solution.q[0], panda.rest, atol=0.05, rtol=0)  # it is there already


def test_out_of_reach_is_an_answer(panda: robots.Robot) -> None:
    target = torch.eye(4)
    target[:3, 3] = torch.tensor([3.0, 0.0, 0.5])
    solution = solve(panda, target, panda.rest, num_seeds=2)
    assert not solution.converged.any()
    assert solution.position_error.item() > 1.5


def test_the_same_seed_gives_the_same_answer(panda: robots.Robot) -> None:
    targets = reachable_targets(panda, 2, seed=4)
    first, second = (solve(panda, targets, panda.rest, seed=3) for _ in range(2))
    assert torch.equal(first.q, second.q)


def test_bad_requests_are_refused(panda: robots.Robot) -> None:
    with pytest.raises(robots.UnknownJointError, match="panda_joint1"):
        solve(panda, torch.eye(4), panda.rest, joints=["elbow"])
    with pytest.raises(robots.RobotError, match="free_axis"):
        solve(panda, torch.eye(4), panda.rest, free_axis=3)
    with pytest.raises(robots.RobotError, match="7"):
        solve(panda, torch.eye(4), torch.zeros(6))
    no_tool = robots.Robot.from_urdf(panda.urdf_path, panda.sphere_set)
    with pytest.raises(robots.RobotError, match="no tool_link"):
        solve(no_tool, torch.eye(4), no_tool.rest)


def test_a_stretched_arm_at_least_damping_still_has_a_step(panda: robots.Robot) -> None:
    q = torch.zeros(1, 7)
    jacobian = torch.zeros(1, 6, 7)
    jacobian[0, :, 0] = torch.tensor([0.3, 0.7, 0.2, 0.5, 0.1, 0.4])  # rank one
    lower, upper = panda.joint_limits.unbind(-1)
    step = _step(
        torch.ones(1, 6), jacobian, q, torch.arange(7), lower - 9, upper + 9, torch.full((1, 1), 1e-4)
    )
    assert torch.isfinite(step).all()
    least_squares = torch.linalg.pinv(jacobian[0].double()) @ torch.ones(6, 1).double()
    torch.testing.assert_close(step[0].double(), least_squares[:, 0], atol=1e-4, rtol=1e-4)
