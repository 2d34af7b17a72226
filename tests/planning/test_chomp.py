import math
import time

import pytest
import torch

from planning import (
    Chomp,
    ChompConfig,
    ConfigError,
    DescentConfig,
    MetricConfig,
    ObjectiveConfig,
    Status,
    Trajectory,
    TrajectoryError,
    check,
)
from tests.planning.fields import (
    Box,
    Cylinder,
    Grid,
    HalfSpace,
    HingeCost,
    NanBeyond,
    Network,
    Room,
    Sphere,
    Union,
    walls_round,
)
from tests.planning.robots import Base, Disc, PlanarArm

POLES = Union(
    Cylinder((1.0, 0.0), 0.4),
    Cylinder((2.0, 0.6), 0.4),
    Cylinder((2.0, -0.7), 0.4),
    Cylinder((3.0, 0.1), 0.3),
)
LOW, HIGH = (-0.5, -1.5, 0.0), (4.5, 1.5, 0.6)


def _line(start, goal, n=40):
    return Trajectory.line(torch.tensor(start), torch.tensor(goal), n)


PAIR = Union(Cylinder((1.0, 0.1), 0.4), Cylinder((3.0, -0.2), 0.4))


@pytest.mark.parametrize(
    "make_field",
    [
        lambda: PAIR,
        lambda: HingeCost(PAIR, 0.2),
        lambda: Grid(PAIR, LOW, HIGH, 0.05),
        lambda: Network(PAIR, LOW, HIGH),
    ],
    ids=["analytic", "cost field", "voxel grid", "network"],
)
def test_one_optimiser_for_every_kind_of_field(make_field):
    field = make_field()
    line = _line([0.0, 0.0], [4.0, 0.0])
    result = Chomp(Disc()).optimise(line, field)
    assert result.success, result.message
    assert check(Disc(), result.trajectory, field).success
    assert torch.equal(result.trajectory.waypoints[[0, -1]], line.waypoints[[0, -1]])
    assert torch.equal(result.trajectory.times, line.times)
    assert result.trajectory.joint_path_length < 1.3 * line.joint_path_length
    assert check(Disc(), result.trajectory, PAIR).clearance > -0.05  # up to the error of grid and network


def test_cost_never_rises_within_a_descent():
    result = Chomp(Disc()).optimise(_line([0.0, 0.0], [4.0, 0.0]), POLES)
    assert result.iterations == len(result.cost_history) > 5
    assert all(
        after <= before for before, after in zip(result.cost_history, result.cost_history[1:], strict=False)
    )
    assert result.clearance > 0 and result.seconds > 0


@pytest.mark.parametrize(
    "metric", [MetricConfig(1.0, 0.0, 0.0), MetricConfig(0.0, 1.0, 0.0), MetricConfig(0.0, 0.0, 1.0)]
)
def test_every_metric_gets_round_an_obstacle(metric):
    result = Chomp(Disc(), ChompConfig(metric=metric)).optimise(
        _line([0.0, 0.0], [2.0, 0.0]), Cylinder((1.0, 0.05), 0.3)
    )
    assert result.success, result.message


@pytest.mark.parametrize("n", [10, 30, 100])
def test_the_number_of_waypoints_hardly_changes_the_path(n):
    result = Chomp(Disc()).optimise(_line([0.0, 0.0], [2.0, 0.0], n), Cylinder((1.0, 0.05), 0.3))
    assert result.success, result.message
    assert float(result.trajectory.waypoints[:, 1].min()) == pytest.approx(-0.42, abs=0.05)


def test_an_obstacle_right_on_the_line_is_passed_on_some_side_and_the_seed_decides():
    line, field = _line([0.0, 0.0], [2.0, 0.0]), Cylinder((1.0, 0.0), 0.3)
    results = [Chomp(Disc(), seed=seed).optimise(line, field) for seed in (0, 0, 1, 2, 3)]
    assert all(r.success for r in results)
    assert torch.equal(results[0].trajectory.waypoints, results[1].trajectory.waypoints)
    assert len({bool(r.trajectory.waypoints[20, 1] > 0) for r in results}) == 2


def test_rotating_the_world_rotates_the_path():
    angle = torch.tensor(0.7)
    turn = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    goal, pole = torch.tensor([2.0, 0.0]), torch.tensor([1.0, 0.1])
    config = ChompConfig(
        perturbation=1e-9, descent=DescentConfig(max_update=10.0)
    )  # the cap is a joint's own and so not invariant
    plain = Chomp(Disc(), config).optimise(
        _line([0.0, 0.0], goal.tolist()), Cylinder(tuple(pole.tolist()), 0.3)
    )
    turned = Chomp(Disc(), config).optimise(
        _line([0.0, 0.0], (turn @ goal).tolist()), Cylinder(tuple((turn @ pole).tolist()), 0.3)
    )
    torch.testing.assert_close(
        plain.trajectory.waypoints @ turn.T, turned.trajectory.waypoints, rtol=0, atol=0.02
    )


def test_arm_in_clutter_keeps_its_limits():
    arm = PlanarArm((0.4, 0.4, 0.3))
    arm.joint_limits = torch.tensor([[-3.0, 3.0], [-0.6, 0.6], [-3.0, 3.0]])
    scene = Union(Sphere((1.0, 0.1, 0.5), 0.12), Sphere((0.2, 1.15, 0.5), 0.1))
    result = Chomp(arm).optimise(_line([-0.9, 0.5, 0.2], [2.0, -0.5, 0.3]), scene)
    assert result.success, result.message
    middle = result.trajectory.waypoints[:, 1]
    assert float(middle.min()) >= -0.6 - 1e-6 and float(middle.max()) <= 0.6 + 1e-6


def test_self_collision_is_optimised_away():
    """The last link lies along the first one and dips into it halfway; nothing but its cost lifts it."""
    arm, far = PlanarArm((0.4, 0.2, 0.4)), Sphere((50.0, 0.0, 0.0), 1.0)
    line = _line([0.0, 1.4, 1.74], [0.0, 1.4, 1.74])
    dipping = line.waypoints.clone()
    dip = 1.1 * torch.linspace(0, math.pi, 40)[1:-1].sin()
    dipping[1:-1, 1:] += torch.stack([-dip, dip], dim=1)
    first = Trajectory(dipping, line.times)
    assert check(arm, first, far).status is Status.SELF_COLLISION
    config = ChompConfig(objective=ObjectiveConfig(smoothness_weight=0.0))
    result = Chomp(arm, config).optimise(first, far)
    assert result.success, result.message
    arm.self_collision_pairs = arm.self_collision_pairs[:0]
    assert torch.equal(Chomp(arm, config).optimise(first, far).trajectory.waypoints, dipping)


def test_base_turns_through_pi_as_real_numbers():
    scene = Union(HalfSpace(), Room(Box((1.0, 0.0, 1.0), (2.0, 1.0, 1.0))), Cylinder((1.0, 0.2), 0.2))
    result = Chomp(Base()).optimise(_line([0.0, 0.0, 3.0], [2.0, 0.0, 4.0]), scene)
    assert result.success, result.message
    assert float(result.trajectory.waypoints[:, 2].diff().abs().max()) < 0.5
    assert float(result.trajectory.waypoints[-1, 2]) == 4.0


def test_poles_between_waypoints_are_seen_in_the_end():
    line = _line([0.0, 0.0], [2.0, 0.0], 5)
    result = Chomp(Disc(0.02)).optimise(line, Cylinder((0.75, 0.005), 0.03))
    assert result.success, result.message
    unaided = Chomp(Disc(0.02), ChompConfig(max_tightenings=0, restarts=0)).optimise(
        line, Cylinder((0.75, 0.005), 0.03)
    )
    assert unaided.status is Status.COLLISION


def test_a_walled_in_goal_is_a_collision_not_a_success():
    result = Chomp(Disc()).optimise(_line([0.0, 0.0], [2.0, 0.0]), walls_round(2.0))
    assert result.status is Status.COLLISION and not result.success
    assert result.clearance < 0 and "inside an obstacle" in result.message


@pytest.mark.parametrize("end, status", [(0, Status.START_IN_COLLISION), (1, Status.GOAL_IN_COLLISION)])
def test_blocked_ends_are_reported_at_once(end, status):
    result = Chomp(Disc()).optimise(_line([0.0, 0.0], [2.0, 0.0]), Cylinder((2.0 * end, 0.0), 0.3))
    assert result.status is status and result.iterations == 0


def test_start_is_goal():
    for n in (2, 3, 20):
        result = Chomp(Disc()).optimise(_line([0.0, 0.0], [0.0, 0.0], n), Cylinder((1.0, 0.0), 0.3))
        assert result.success and torch.equal(result.trajectory.waypoints, torch.zeros(n, 2))


@pytest.mark.parametrize("n", [1, 2])
def test_nothing_to_optimise_is_checked_only(n):
    trajectory = _line([0.0, 0.0], [2.0, 0.0], n)
    assert Chomp(Disc()).optimise(trajectory, Cylinder((1.0, 2.0), 0.3)).success
    blocked = Chomp(Disc()).optimise(trajectory, Cylinder((1.0, 0.0), 0.3))
    assert blocked.iterations == 0 and blocked.success is (n == 1)


def test_deadline_zero_returns_the_checked_input():
    line = _line([0.0, 0.0], [4.0, 0.0])
    result = Chomp(Disc()).optimise(line, POLES, deadline=0.0)
    assert result.status is Status.COLLISION and result.iterations == 0
    assert torch.equal(result.trajectory.waypoints, line.waypoints)
    assert Chomp(Disc()).optimise(line, Cylinder((1.0, 3.0), 0.3), deadline=0.0).success


def test_deadline_is_kept(monkeypatch):
    """By a clock that only the field moves on."""
    now = [0.0]

    class Slow(Cylinder):
        def distance_and_gradient(self, points):
            now[0] += 0.02
            return super().distance_and_gradient(points)

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    walls = Slow((1.0, 0.0), 0.95)
    result = Chomp(Disc(0.02), ChompConfig(descent=DescentConfig(tolerance=0.0))).optimise(
        _line([0.0, 0.0], [2.0, 0.0]), walls, deadline=0.3
    )
    assert 0.2 < result.seconds <= 0.33 and 0 < result.iterations < 20


def test_waypoints_outside_the_limits():
    arm, far = PlanarArm(), Sphere((50.0, 0.0, 0.0), 1.0)
    goal_outside = Chomp(arm).optimise(_line([0.0, 0.0], [0.0, 3.3]), far)
    assert goal_outside.status is Status.JOINT_LIMITS and "joint2" in goal_outside.message
    inside = _line([0.0, 0.0], [0.0, 1.0])
    waypoints = inside.waypoints.clone()
    waypoints[15:25, 0] = 3.4
    repaired = Chomp(arm).optimise(Trajectory(waypoints, inside.times), far)
    assert repaired.success, repaired.message


def test_nan_in_the_field_is_reported():
    field = NanBeyond(Cylinder((1.0, 0.0), 0.3), 1.2)
    through = Chomp(Disc()).optimise(_line([0.0, 0.0], [1.1, 1.0], 20), field)
    assert through.success, through.message  # the NaN is not on the way
    assert Chomp(Disc()).optimise(_line([0.0, 0.0], [2.0, 0.0]), field).status is Status.INVALID_FIELD
    waypoints = torch.tensor([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0], [1.0, 1.2], [0.0, 1.2]])
    beyond = Chomp(Disc()).optimise(Trajectory.through(waypoints, 30), field)
    assert beyond.status is Status.INVALID_FIELD and "NaN" in beyond.message
    assert beyond.iterations == 0  # there is no gradient to follow


def test_mismatched_joints_and_bad_settings_are_refused():
    with pytest.raises(TrajectoryError, match="3 joints"):
        Chomp(Disc()).optimise(_line([0.0] * 3, [1.0] * 3), POLES)
    with pytest.raises(ConfigError, match="eps"):
        ChompConfig(eps=0.0)
    with pytest.raises(ConfigError, match="weights"):
        ObjectiveConfig(obstacle_weight=-1.0)


def test_float64_stays_float64():
    line = Trajectory.line(torch.zeros(2).double(), torch.tensor([4.0, 0.0]).double(), 30)
    result = Chomp(Disc()).optimise(line, POLES)
    assert result.success and result.trajectory.waypoints.dtype is torch.float64
