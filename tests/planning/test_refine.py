"""Motions that wheels can follow: their rule, their limits, and the clearances they keep."""

import math

import numpy as np
import pytest
import torch

from planning import ConfigError, PrimitiveField, Solid, Status, Trajectory, TrajectoryError, check
from planning.drive_path import driveable
from planning.linear_clearance import ClearanceModel
from planning.refine import RefineConfig, Refiner
from planning.workspace import WorkspaceConfig
from tests.planning.fields import AutogradField
from tests.planning.robots import Base, PlanarArm

FLOOR = Solid("box", (20, 20, 0.1), (0, 0, -0.05))
FREE = PrimitiveField([FLOOR])
ACCELERATIONS = torch.tensor([0.5, 0.5, 1.5])


def to(*goal: float) -> Trajectory:
    return Trajectory.line(torch.zeros(3), torch.tensor(goal), 20)


def driven(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Distance along the mean heading and across it, of every segment [m]."""
    q = trajectory.waypoints.numpy()
    step, heading = np.diff(q, axis=0), (q[1:, 2] + q[:-1, 2]) / 2
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * step[:, 0] + sin * step[:, 1], cos * step[:, 1] - sin * step[:, 0]


def assert_keeps(trajectory: Trajectory, velocity, acceleration) -> None:
    """Wheels, speeds and accelerations, from rest to rest."""
    along, across = driven(trajectory)
    assert np.abs(across).max() < 1e-7
    q, h = trajectory.waypoints.numpy(), float(trajectory.times[1])
    joints = [0, *range(2, q.shape[1])]
    speed = np.c_[along, np.diff(q[:, 2:], axis=0)] / h
    assert (np.abs(speed) <= velocity.numpy()[joints] * (1 + 1e-6)).all()
    change = np.diff(speed, axis=0, prepend=0, append=0) / h
    change[[0, -1]] *= 2  # half a segment to start and to stop
    assert (np.abs(change) <= acceleration.numpy()[joints] * (1 + 1e-6)).all()


@pytest.mark.parametrize(
    "goal",
    [(2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 1.0, -2.0), (0.0, 0.0, 2.5), (0.0, 0.0, 0.0)],
)
def test_wheels_limits_and_ends_are_kept(goal) -> None:
    robot = Base()
    result = Refiner(robot, ACCELERATIONS).refine(to(*goal), FREE)
    assert result.success, result.message
    assert_keeps(result.trajectory, robot.velocity_limits, ACCELERATIONS)
    q = result.trajectory.waypoints
    torch.testing.assert_close(q[0], torch.zeros(3, dtype=q.dtype))
    torch.testing.assert_close(q[-1, :2], torch.tensor(goal[:2], dtype=q.dtype))
    assert math.remainder(float(q[-1, 2]) - goal[2], 2 * math.pi) == pytest.approx(0, abs=1e-6)
    # No faster than the limits allow, and not much slower than turning, driving and turning.
    straight = math.hypot(*goal[:2]) / 0.5
    assert straight < result.trajectory.duration < straight + 2 * math.pi + 4


def test_a_straight_drive_takes_the_shortest_time() -> None:
    result = Refiner(Base(), ACCELERATIONS, RefineConfig(smoothness=0.001)).refine(to(2.0, 0.0, 0.0), FREE)
    assert result.trajectory.duration == pytest.approx(2.0 / 0.5 + 0.5 / 0.5, rel=0.02)


@pytest.mark.parametrize(("reverse", "turns"), [(0.3, False), (0.0, True)])
def test_it_backs_up_only_where_that_is_allowed(reverse, turns) -> None:
    result = Refiner(Base(), ACCELERATIONS, RefineConfig(reverse_speed=reverse)).refine(to(-0.6, 0, 0), FREE)
    assert result.success
    along, _ = driven(result.trajectory)
    assert along.min() / float(result.trajectory.times[1]) >= -reverse - 1e-6
    assert (float(result.trajectory.waypoints[:, 2].abs().max()) > 3.0) == turns


def test_the_bend_is_kept_clear_of_what_the_slide_passed() -> None:
    """The path slides up to a post that the base, driving towards it, would touch."""
    post = PrimitiveField([FLOOR, Solid("box", (0.1, 0.1, 1.0), (0.0, 1.27, 0.5))])
    path = to(0.0, 1.0, 0.0)
    robot, config = Base(), RefineConfig(margin=0.03)
    first = torch.from_numpy(driveable(path.waypoints.double().numpy(), (0, 1, 2), False)[0])
    assert check(robot, path, post).success
    assert check(robot, Trajectory.through(first), post).clearance < 0
    result = Refiner(robot, ACCELERATIONS, config).refine(path, post)
    assert result.success and result.clearance > 0.029, result.message
    assert_keeps(result.trajectory, robot.velocity_limits, ACCELERATIONS)


def test_a_path_through_a_wall_is_no_success() -> None:
    wall = PrimitiveField([FLOOR, Solid("box", (0.2, 30.0, 1.0), (1.0, 0.0, 0.5))])
    result = Refiner(Base(), ACCELERATIONS).refine(to(2.0, 0.0, 0.0), wall)
    assert result.status is Status.COLLISION and "inside an obstacle" in result.message


@pytest.mark.parametrize("x, status", [(0.0, Status.START_IN_COLLISION), (2.0, Status.GOAL_IN_COLLISION)])
def test_blocked_ends_are_reported_before_anything_is_solved(x, status) -> None:
    blocked = PrimitiveField([FLOOR, Solid("box", (0.1, 0.1, 1.0), (x, 0.0, 0.5))])
    result = Refiner(Base(), ACCELERATIONS).refine(to(2.0, 0.0, 0.0), blocked)
    assert result.status is status and result.iterations == 0


@pytest.mark.parametrize("end", [2.0, 9.0], ids=["between the ends", "to the goal"])
def test_a_field_without_numbers_is_said_to_be_one(end) -> None:
    class Hole(AutogradField):
        def distance(self, points):
            return torch.where((points[..., 0] > 1.0) & (points[..., 0] < end), torch.nan, points[..., 2])

    result = Refiner(Base(), ACCELERATIONS).refine(to(3.0, 0.0, 0.0), Hole())
    assert result.status is Status.INVALID_FIELD and "NaN" in result.message


def test_an_arm_without_wheels_is_timed_and_kept_clear() -> None:
    arm = PlanarArm((0.5, 0.4, 0.3))
    post = PrimitiveField([Solid("cylinder", (2.0, 0.05), (0.75, 0.75, 0.5))])
    start, goal = torch.tensor([-0.4, 0.3, 0.2]), torch.tensor([2.0, 0.3, 0.2])
    via = torch.tensor([0.8, 2.2, 0.6])
    path = Trajectory.through(torch.stack([start, via, goal]), 40)
    limits = torch.full((3,), 4.0)
    result = Refiner(arm, limits, RefineConfig(base_joints=())).refine(path, post)
    assert result.success and result.clearance > 0.015, result.message
    q, h = result.trajectory.waypoints, float(result.trajectory.times[1])
    assert float(q.diff(dim=0).abs().max()) <= 2.0 * h * (1 + 1e-6)
    assert float(q.diff(dim=0).diff(dim=0).abs().max()) <= 4.0 * h**2 * (1 + 1e-6)


def test_slopes_of_the_clearances_are_finite_differences() -> None:
    arm = PlanarArm((0.5, 0.4, 0.3))
    field = PrimitiveField([Solid("sphere", (0.1,), (0.7, 0.3, 0.5))])
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (5, 3))
    q[1] = [0.1, 2.6, 2.5]  # folded: links near each other
    away = np.array([[3.0, 0.0, 0.0]] * 2)
    model = ClearanceModel(arm, field, away, 0.02, 0.01, WorkspaceConfig())
    at = model.at(q)
    for joint in range(3):
        step = np.zeros(3)
        step[joint] = 1e-6
        ahead, behind = model.at(q + step), model.at(q - step)
        np.testing.assert_allclose((ahead.gap - behind.gap) / 2e-6, at.rows[..., joint], atol=1e-4)
    assert at.rows[..., -1, :].any(), "one of the postures must have links near each other"


def test_what_does_not_fit_is_named() -> None:
    with pytest.raises(ConfigError, match="base_x, base_y, base_yaw is no joint"):
        Refiner(PlanarArm(), torch.ones(2))
    with pytest.raises(ConfigError, match="3 positive finite numbers"):
        Refiner(Base(), torch.tensor([1.0, 0.0, 1.0]))
    with pytest.raises(ConfigError, match="x, y and yaw"):
        RefineConfig(base_joints=("base_x",))
    with pytest.raises(ConfigError, match="fewest <= most"):
        RefineConfig(fewest=50, most=40)
    with pytest.raises(ConfigError, match="margin must be a number"):
        RefineConfig(margin=math.nan)
    with pytest.raises(TrajectoryError, match="2 joints a waypoint"):
        Refiner(Base(), ACCELERATIONS).refine(Trajectory.line(torch.zeros(2), torch.ones(2)), FREE)
