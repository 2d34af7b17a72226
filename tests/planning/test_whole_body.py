"""Base and arm of a mobile manipulator planned together: through a doorway and round a table to a posture at it."""

import time

import numpy as np
import pytest
import torch

from planning import (
    ChompConfig,
    DescentConfig,
    NoPath,
    Planner,
    PlannerConfig,
    PrimitiveField,
    RrtConfig,
    Solid,
    Trajectory,
    check,
    retime,
    rrt_connect,
)
from planning.refine import Refiner

robots = pytest.importorskip("robots")

DOOR = [Solid("box", (0.1, 3.0, 2.0), (1.5, side * 2.0, 1.0)) for side in (-1, 1)]  # 1 m wide
LEGS = [Solid("box", (0.05, 0.05, 0.7), (x, y, 0.35)) for x in (3.7, 4.3) for y in (0.0, 1.2)]
FLAT = PrimitiveField(
    [Solid("box", (20, 20, 0.1), (0, 0, -0.05)), *DOOR, Solid("box", (0.8, 1.4, 0.05), (4, 0.6, 0.72)), *LEGS]
)


@pytest.fixture(scope="module")
def tiago():
    return robots.load("tiago")


@pytest.fixture(scope="module")
def ends(tiago):
    start, goal = tiago.named["tucked"].double(), tiago.named["ready"].double()
    goal[:3] = torch.tensor([4.9, 0.6, np.pi])  # behind the table, facing it
    return start, goal


@pytest.fixture(scope="module")
def planned(tiago, ends):
    planner = Planner(tiago, PlannerConfig(chomp=ChompConfig(eps=0.1)))
    return planner, planner.plan(*ends, FLAT)


def test_through_the_door_and_round_the_table(tiago, ends, planned):
    start, goal = ends
    assert not check(tiago, Trajectory.line(start, goal), FLAT).success
    _, result = planned
    assert result.success and result.clearance > 0.02, result.message
    q = result.trajectory.waypoints
    assert torch.equal(q[0], start) and torch.equal(q[-1], goal)
    assert check(tiago, result.trajectory, FLAT).success
    # Base and arm move at the same time, not one after the other.
    driving, reaching = (q.diff(dim=0)[:, part].norm(dim=1) > 1e-3 for part in (slice(0, 2), slice(4, 11)))
    assert float((driving & reaching).float().mean()) > 0.5


def test_the_search_alone_finds_the_door(tiago, ends):
    """Samples must be drawn near the ends, not all over the hundred metres that the base may travel."""
    path = rrt_connect(tiago, FLAT, *ends, RrtConfig(seconds=10.0, candidates=1))
    assert not isinstance(path, NoPath), path
    assert check(tiago, Trajectory.through(path), FLAT).success


def test_replanning_from_the_last_plan_is_quick_and_stays_near_it(tiago, ends, planned):
    _, last = planned
    quick = ChompConfig(eps=0.1, descent=DescentConfig(polish=10))
    planner = Planner(tiago, PlannerConfig(chomp=quick))
    start, rest = last.trajectory.waypoints[8], last.trajectory.waypoints[9:]
    ahead = Trajectory(torch.cat([start[None], rest]), last.trajectory.times[8:]).resampled(40)
    began = time.process_time()
    again = planner.plan(start, ends[1], FLAT, warm_start=ahead)
    assert time.process_time() - began < 0.5  # less than a tenth of a second on a quiet machine
    assert again.success and again.iterations <= 20, again.message
    there = again.trajectory.waypoints[:, None, :2] - last.trajectory.waypoints[None, :, :2]
    assert float(there.norm(dim=-1).amin(dim=1).max()) < 0.2


def test_a_robot_that_is_there_already_stays(tiago, ends):
    start, goal = ends
    result = Planner(tiago).plan(start, torch.stack([goal, start]), FLAT)
    assert result.success and result.trajectory.joint_path_length == 0, result.message
    limits = tiago.velocity_limits.double()
    assert retime(result.trajectory, limits, limits).duration > 0


def test_the_plan_is_made_one_that_wheels_can_follow(tiago, ends, planned):
    plan = planned[1].trajectory
    accelerations = torch.tensor([0.6, 0.6, 1.5] + [2.0] * 8, dtype=torch.float64)
    result = Refiner(tiago, accelerations).refine(plan, FLAT)
    assert result.success and result.clearance > 0.015, result.message
    q, h = result.trajectory.waypoints, float(result.trajectory.times[1])
    heading = (q[1:, 2] + q[:-1, 2]) / 2
    step, wheel = q.diff(dim=0), torch.stack([heading.cos(), heading.sin()], dim=1)
    across = step[:, 0] * wheel[:, 1] - step[:, 1] * wheel[:, 0]
    assert float(across.abs().max()) < 1e-7 < 1e-3 < float(sideways(plan.waypoints.double()))
    speed = torch.cat([(step[:, :2] * wheel).sum(dim=1, keepdim=True), step[:, 2:]], dim=1) / h
    joints = [0, *range(2, 11)]
    assert (speed.abs() <= tiago.velocity_limits.double()[joints] * (1 + 1e-6)).all()
    assert (speed.diff(dim=0).abs() <= accelerations[joints] * h * (1 + 1e-6)).all()
    torch.testing.assert_close(q[[0, -1], :2], plan.waypoints[[0, -1], :2].double())
    torch.testing.assert_close(q[[0, -1], 3:], plan.waypoints[[0, -1], 3:].double())


def sideways(q):
    """Largest slide [m] of the base across its heading in one step."""
    heading, step = (q[1:, 2] + q[:-1, 2]) / 2, q.diff(dim=0)
    return (step[:, 0] * heading.sin() - step[:, 1] * heading.cos()).abs().max()
