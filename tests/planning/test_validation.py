import math

import pytest
import torch

from planning import (
    ChompConfig,
    ConfigError,
    Planner,
    PlannerConfig,
    RrtConfig,
    Status,
    Trajectory,
    TrajectoryError,
    ValidationConfig,
    WorkspaceConfig,
    check,
)
from planning.ends import check_ends
from tests.planning.fields import Box, Confident, Cylinder, HingeCost, NanBeyond, Sphere
from tests.planning.robots import Base, Disc, PlanarArm

FAR = Sphere((50.0, 0.0, 0.0), 1.0)


def _line(*points):
    return Trajectory.through(torch.tensor(points))


def test_clearance_of_a_passing_disc_is_exact():
    verdict = check(Disc(0.1), _line([0.0, 0.0], [4.0, 0.0]), Cylinder((1.3, 0.5), 0.2))
    assert verdict.success and verdict.status is Status.SUCCESS
    assert verdict.clearance == pytest.approx(0.2, abs=1e-3)
    assert verdict.time == pytest.approx(5.0 * 1.3 / 4.0, abs=0.02)


@pytest.mark.parametrize("centre", [0.37, 1.0, 2.501])
def test_a_thin_pole_between_two_waypoints_is_found(centre):
    verdict = check(Disc(0.01), _line([0.0, 0.0], [3.0, 0.0]), Cylinder((centre, 0.0), 0.006))
    assert verdict.status is Status.COLLISION
    assert verdict.clearance == pytest.approx(-0.016, abs=0.006)


def test_samples_are_as_dense_as_promised_for_every_sphere():
    arm = PlanarArm((0.5, 0.5, 0.5))
    trajectory = _line([-2.0, 1.0, -1.0], [1.0, -2.0, 2.0], [1.1, -2.0, 2.0])
    coarse = check(arm, trajectory, FAR)
    states = trajectory.at(torch.linspace(0, trajectory.duration, 5000))
    centres, _ = arm.spheres(states)
    path = float(centres.diff(dim=0).norm(dim=-1).sum(0).amax())
    assert path / 0.01 <= coarse.states <= 2.5 * path / 0.01
    fine = check(arm, trajectory, FAR, ValidationConfig(max_step=0.002))
    assert fine.states > 4 * coarse.states


def test_a_full_turn_between_two_waypoints_is_not_skipped():
    """Seen from its ends, such a motion does not move at all."""
    base = Base(offsets=torch.tensor([[0.5, 0.0, 0.5]]))
    verdict = check(base, _line([0.0, 0.0, 0.0], [0.0, 0.0, 2 * math.pi]), Cylinder((-0.5, 0.0), 0.05))
    assert verdict.status is Status.COLLISION and verdict.time == pytest.approx(2.5, abs=0.4)


def test_messages_name_waypoint_link_and_depth():
    arm = PlanarArm((0.5, 0.5))
    trajectory = Trajectory.line(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 0.0]), 11)
    verdict = check(arm, trajectory, Sphere((0.85, 0.0, 0.5), 0.1))
    assert verdict.status is Status.COLLISION
    assert verdict.link == "link link2" and verdict.waypoint == 5
    assert "waypoint 5 of 11" in verdict.message and "link link2" in verdict.message
    assert f"{-verdict.clearance:.3f} m inside" in verdict.message
    assert verdict.clearance == pytest.approx(-0.15, abs=2e-3)


@pytest.mark.parametrize(
    "start, goal, status", [(0.0, 2.0, "START_IN_COLLISION"), (2.0, 0.0, "GOAL_IN_COLLISION")]
)
def test_start_and_goal_are_told_apart(start, goal, status):
    trajectory = _line([start, 0.0], [goal, 0.0])
    field = Cylinder((0.0, 0.0), 0.3)
    assert check(Disc(), trajectory, field).status is Status[status]
    ends = check_ends(Disc(), trajectory, field)
    assert ends.status is Status[status]
    assert ends.waypoint == (0 if status.startswith("START") else 1)


def test_margin_is_demanded():
    trajectory, field = _line([0.0, 0.0], [2.0, 0.0]), Cylinder((1.0, 0.33), 0.2)
    assert check(Disc(0.1), trajectory, field).success
    verdict = check(Disc(0.1), trajectory, field, ValidationConfig(margin=0.05))
    assert verdict.status is Status.COLLISION and "margin 0.05 m" in verdict.message


def test_self_collision():
    arm = PlanarArm((0.4, 0.2, 0.4))
    assert check(arm, _line([0.0, 0.5, 0.5], [0.0, 1.0, 1.0]), FAR).success
    folding = check(arm, _line([0.0, 1.0, 1.0], [0.0, 2.9, 2.9], [0.0, 1.0, 1.0]), FAR)
    assert folding.status is Status.SELF_COLLISION
    assert "link1" in folding.message and "link3" in folding.message and folding.self_clearance < 0
    assert check(arm, _line([0.0, 2.9, 2.9], [0.0, 0.0, 0.0]), FAR).status is Status.START_IN_COLLISION


def test_joint_limits_name_the_joint():
    verdict = check(PlanarArm(), _line([0.0, 0.0], [0.0, 3.2], [0.0, 0.0]), FAR)
    assert verdict.status is Status.JOINT_LIMITS
    assert "joint2" in verdict.message and "3.2" in verdict.message and verdict.waypoint == 1


def test_nan_is_never_free():
    verdict = check(Disc(), _line([0.0, 0.0], [2.0, 0.0], [0.0, 0.0]), NanBeyond(FAR, 1.5))
    assert verdict.status is Status.INVALID_FIELD
    assert math.isnan(verdict.clearance) and not verdict.success
    assert "NaN" in verdict.message


def test_cost_fields_are_checked_by_their_distances():
    field = Box((1.0, 0.0, 0.3), (0.2, 0.2, 0.2))
    plain = check(Disc(), _line([0.0, 0.3], [2.0, 0.4]), field)
    wrapped = check(Disc(), _line([0.0, 0.3], [2.0, 0.4]), HingeCost(field, 0.5))
    assert plain.clearance == wrapped.clearance and plain.status is wrapped.status


def test_unknown_space_does_not_fail_the_check():
    assert check(Disc(), _line([0.0, 0.0], [2.0, 0.0]), Confident(FAR, 1.0)).success


def test_one_waypoint_and_float64():
    one = Trajectory(torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    assert check(Disc(), one, FAR).success


def test_mismatched_joints_are_refused():
    with pytest.raises(TrajectoryError, match="3 joints a waypoint, but the robot has 2: base_x, base_y"):
        check(Disc(), _line([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), FAR)


def test_unknown_space_is_dear_or_forbidden():
    """The short way leads through what was never seen; a detour over known ground exists."""
    field = Confident(Sphere((50.0, 0.0, 0.0), 1.0), 0.0)
    field.confidence = lambda points: ((points[..., :2] - torch.tensor([1.0, 0.1])).norm(dim=-1) > 0.4).to(
        points
    )
    line = _line([0.0, 0.0], [2.0, 0.0])
    dear, never = WorkspaceConfig(unknown_confidence=0.5), WorkspaceConfig(0.1, 0.5, unknown_forbidden=True)
    assert check(Disc(), line, field, ValidationConfig(workspace=dear)).success
    verdict = check(Disc(), line, field, ValidationConfig(workspace=never))
    assert verdict.status is Status.UNKNOWN_SPACE and "sphere 0 is in unknown space" in verdict.message
    assert 0.6 < float(line.at(verdict.time)[0]) < 0.65  # where it begins
    config = PlannerConfig(
        chomp=ChompConfig(validation=ValidationConfig(workspace=never)), rrt=RrtConfig(workspace=never)
    )
    result = Planner(Disc(), config).plan(torch.zeros(2), torch.tensor([2.0, 0.0]), field)
    assert result.success, result.message
    assert check(Disc(), result.trajectory, field, ValidationConfig(workspace=never)).success
    with pytest.raises(ConfigError, match="needs unknown_confidence"):
        WorkspaceConfig(unknown_forbidden=True)
