import math

import pytest
import torch

from planning import AxisConstraint, Chomp, ChompConfig, GoalPose, ObjectiveConfig, Status, Trajectory
from planning.constraints import linearised, project_to_constraints, violation
from planning.metric import Metric
from tests.gradients import assert_gradient_matches
from tests.planning.fields import Sphere
from tests.planning.robots import PlanarArm

FAR = Sphere((50.0, 0.0, 0.0), 1.0)


def _turn(axis, angle):
    """Poses turned about an axis (0, 1, 2) by angles (...)."""
    cos, sin, one = torch.cos(angle), torch.sin(angle), torch.ones_like(angle)
    zero = torch.zeros_like(angle)
    rows = [[one, zero, zero], [zero, cos, -sin], [zero, sin, cos]]
    order = [(i - axis) % 3 for i in range(3)]
    pose = torch.eye(4, dtype=angle.dtype).expand(*angle.shape, 4, 4).clone()
    for i in range(3):
        for j in range(3):
            pose[..., i, j] = rows[order[i]][order[j]]
    return pose


def _floating(q):
    """A body that q = (x, y, z, three turns) places: poses (..., 4, 4)."""
    pose = _turn(2, q[..., 3]) @ _turn(1, q[..., 4]) @ _turn(0, q[..., 5])
    return torch.cat([torch.cat([pose[..., :3, :3], q[..., :3, None]], dim=-1), pose[..., 3:, :]], dim=-2)


def _tip(arm):
    """Poses of a planar arm's tip, x along the last link."""

    def pose_of(q):
        angle = q.cumsum(-1)
        lengths = torch.tensor(arm.lengths).to(q)
        pose = _turn(2, angle[..., -1])
        at = torch.stack([(angle.cos() * lengths).sum(-1), (angle.sin() * lengths).sum(-1)], dim=-1)
        at = torch.cat([at, torch.full_like(at[..., :1], 0.5)], dim=-1)
        return torch.cat([torch.cat([pose[..., :3, :3], at[..., None]], -1), pose[..., 3:, :]], -2)

    return pose_of


def _given(q):
    """Poses written out as configurations."""
    return q.reshape(*q.shape[:-1], 4, 4)


def _q(*values):
    return torch.tensor([values], dtype=torch.float64)


TARGET = _floating(_q(0.3, -0.2, 0.7, 0.4, -0.6, 1.1))[0]


@pytest.mark.parametrize("axis", [None, 0, 1, 2])
def test_a_goal_pose_is_met_there_and_nowhere_else(axis):
    goal = GoalPose(_given, TARGET, axis)
    assert float(goal.residual(TARGET.reshape(1, 16)).abs().max()) < 1e-12
    moved = TARGET.clone()
    moved[:3, 3] += TARGET[:3, 1] * 0.05
    assert float(goal.residual(moved.reshape(1, 16)).norm()) == pytest.approx(0.05)
    for about in range(3):
        for angle in (0.1, 1.0, 2.5, math.pi):
            left = goal.residual((TARGET @ _turn(about, torch.tensor(angle).double())).reshape(1, 16))
            expected = math.sin(angle) if angle < math.pi / 2 else 1.0
            assert float(left.norm()) == pytest.approx(0.0 if about == axis else expected, abs=1e-6)


def test_a_small_turn_is_told_as_its_rotation_vector():
    turned = TARGET @ _turn(0, torch.tensor(0.01).double()) @ _turn(2, torch.tensor(-0.02).double())
    left = GoalPose(_given, TARGET).residual(turned.reshape(1, 16))[0]
    torch.testing.assert_close(left[3:], torch.tensor([0.01, 0.0, -0.02]).double(), rtol=0, atol=2e-4)


def test_where_the_world_is_does_not_matter():
    world, pose = _floating(_q(1.0, 2.0, 3.0, 0.3, 0.2, -0.5))[0], _floating(_q(0.2, 0, 0, 0.1, 0.5, 0.9))
    for axis in (None, 1):
        here = GoalPose(_given, TARGET, axis).residual(pose.reshape(1, 16))
        there = GoalPose(_given, world @ TARGET, axis).residual((world @ pose).reshape(1, 16))
        torch.testing.assert_close(here, there)


def test_an_axis_may_turn_about_itself_but_not_tip_over():
    upright = AxisConstraint(_given, torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, 1]))
    for angle in (0.3, 2.0, math.pi):
        turned = _turn(2, torch.tensor(angle).double()).reshape(1, 16)
        assert float(upright.residual(turned).abs().max()) < 1e-9
        tipped = upright.residual(_turn(0, torch.tensor(angle).double()).reshape(1, 16))
        assert float(tipped.norm()) == pytest.approx(math.sin(angle) if angle < 1.57 else 1.0, abs=1e-6)


@pytest.mark.parametrize("kind", ["pose", "free axis", "axis"])
def test_jacobians(kind):
    constraint = {
        "pose": GoalPose(_floating, TARGET),
        "free axis": GoalPose(_floating, TARGET, free_axis=1),
        "axis": AxisConstraint(_floating, torch.tensor([0.0, 0.6, 0.8]), torch.tensor([0.0, 0.0, 1.0])),
    }[kind]
    q = torch.rand(2, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    _, jacobian = linearised(constraint, q)
    for row in range(jacobian.shape[1]):
        assert_gradient_matches(
            lambda x, row=row: constraint.residual(x)[:, row].sum(), lambda x, row=row: jacobian[:, row], q
        )


@pytest.mark.parametrize("n", [10, 60])
def test_projection_reaches_the_goal_smoothly_and_leaves_the_start(n):
    goal = GoalPose(_floating, TARGET, free_axis=2)
    q = torch.zeros(n, 6, dtype=torch.float64)
    projected = project_to_constraints(q, Metric(n, free_goal=True), [goal], iterations=30)
    assert torch.equal(projected[0], q[0])
    assert violation([goal], projected) < 1e-4 < violation([goal], q)
    steps = projected.diff(dim=0).norm(dim=1)
    assert float(steps.max()) < 4 * float(projected[-1].norm()) / n  # the whole trajectory follows


def test_projection_without_need_changes_nothing():
    upright = AxisConstraint(_floating, torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, 1]))
    q = torch.rand(8, 6, dtype=torch.float64)
    q[:, 4:] = 0.0
    assert torch.equal(project_to_constraints(q, Metric(8), [upright]), q)


def test_chomp_brings_the_tip_to_a_pose_and_keeps_its_direction():
    arm = PlanarArm((0.4, 0.4, 0.3))
    pose_of, start = _tip(arm), torch.tensor([1.2, -0.6, -0.6]).double()
    target = pose_of(torch.tensor([0.4, 0.7, -1.1]).double())
    along = AxisConstraint(pose_of, torch.tensor([1.0, 0, 0]), torch.tensor([1.0, 0, 0]))
    config = ChompConfig(objective=ObjectiveConfig(smoothness_weight=0.5))
    guess = Trajectory.line(start, start, 20)
    result = Chomp(arm, config).optimise(guess, FAR, constraints=[along, GoalPose(pose_of, target)])
    assert result.success, result.message
    poses = pose_of(result.trajectory.waypoints)
    assert torch.equal(result.trajectory.waypoints[0], start)
    torch.testing.assert_close(poses[-1], target, rtol=0, atol=1e-3)
    assert float((poses[:, :3, 0] - torch.tensor([1.0, 0, 0]).double()).abs().max()) < 2e-3


def test_a_pose_out_of_reach_is_a_status():
    arm = PlanarArm((0.4, 0.4, 0.3))
    target = torch.eye(4, dtype=torch.float64)
    target[:3, 3] = torch.tensor([3.0, 0.0, 0.5])
    start = torch.tensor([1.2, -0.6, -0.6]).double()
    goal = GoalPose(_tip(arm), target)
    config = ChompConfig(max_iterations=40, max_tightenings=1, restarts=0)
    result = Chomp(arm, config).optimise(Trajectory.line(start, start, 15), FAR, constraints=[goal])
    assert result.status is Status.CONSTRAINT and "constraint is violated" in result.message
