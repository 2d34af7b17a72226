import time

import pytest
import torch

from planning import (
    ChompConfig,
    ConfigError,
    ObjectiveConfig,
    Planner,
    PlannerConfig,
    RrtConfig,
    Status,
    Trajectory,
    check,
)
from tests.planning.fields import Box, Cylinder, HalfSpace, HingeCost, NanBeyond, Sphere, Union, walls_round
from tests.planning.robots import Base, Disc
from tests.planning.test_initialise import TRAP


def test_an_easy_problem_is_left_to_chomp():
    result = Planner(Disc()).plan(torch.zeros(2), torch.tensor([2.0, 0.0]), Cylinder((1.0, 0.1), 0.3))
    assert result.success and result.iterations > 0


@pytest.mark.parametrize("field", [TRAP, HingeCost(TRAP, 0.1)], ids=["distances", "costs"])
def test_a_trap_is_left_with_the_help_of_the_search(field):
    start, goal = torch.tensor([1.0, 0.0]), torch.tensor([4.0, 0.5])
    result = Planner(Disc()).plan(start, goal, field)
    assert result.success, result.message
    assert torch.equal(result.trajectory.waypoints[0], start) and torch.equal(
        result.trajectory.waypoints[-1], goal
    )
    assert check(Disc(), result.trajectory, TRAP).success


def test_the_searched_path_is_returned_where_chomp_leaves_what_is_free():
    start, goal = torch.tensor([1.0, 0.0]), torch.tensor([4.0, 0.5])
    careless = ObjectiveConfig(smoothness_weight=1.0, obstacle_weight=0.0, margin=-1.0)
    config = PlannerConfig(chomp=ChompConfig(objective=careless, max_tightenings=0, restarts=0))
    result = Planner(Disc(), config).plan(start, goal, TRAP)
    assert result.success and "not optimised" in result.message
    assert check(Disc(), result.trajectory, TRAP).success


def test_a_base_gets_through_a_doorway():
    walls = Union(HalfSpace(), Box((1.0, 1.35, 0.5), (0.1, 1.0, 0.5)), Box((1.0, -2.2, 0.5), (0.1, 2.0, 0.5)))
    start, goal = torch.tensor([0.0, 0.8, 1.5]), torch.tensor([2.0, 0.8, 1.5])
    result = Planner(Base()).plan(start, goal, walls)
    assert result.success, result.message


def test_no_path():
    config = PlannerConfig(rrt=RrtConfig(seconds=0.3))
    result = Planner(Disc(), config).plan(torch.zeros(2), torch.tensor([2.0, 0.0]), walls_round(2.0))
    assert result.status is Status.NO_PATH and not result.success
    assert "no path found" in result.message and "inside an obstacle" in result.message


def test_deadline_zero_comes_back_at_once_without_a_false_success():
    result = Planner(Disc()).plan(torch.tensor([1.0, 0.0]), torch.tensor([4.0, 0.5]), TRAP, deadline=0.0)
    assert result.status is Status.NO_PATH and result.seconds < 1.0


@pytest.mark.parametrize("deadline", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("field", [TRAP, walls_round(4.0)], ids=["trap", "walls"])
def test_a_deadline_is_kept_to_a_tenth(deadline, field, monkeypatch):
    """By a clock that only the field moves on."""
    now = [0.0]

    class Ticking(Union):
        def distance(self, points):
            now[0] += 1e-3 + 5e-6 * points[..., 0].numel()
            return super().distance(points)

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    start, goal = torch.tensor([1.0, 0.0]), torch.tensor([4.0, 0.1])
    result = Planner(Disc()).plan(start, goal, Ticking(*field.parts), deadline=deadline)
    assert result.seconds <= 1.1 * deadline
    if field is TRAP and deadline >= 2.0:
        assert result.success, result.message


@pytest.mark.parametrize("end, status", [(0, Status.START_IN_COLLISION), (1, Status.GOAL_IN_COLLISION)])
def test_blocked_ends(end, status):
    pole = Cylinder((2.0 * end, 0.0), 0.3)
    result = Planner(Disc()).plan(torch.zeros(2), torch.tensor([2.0, 0.0]), pole)
    assert result.status is status and result.iterations == 0


def test_a_way_round_nan_is_found():
    class Hole(NanBeyond):
        def distance(self, points):
            distance = self.field.distance(points)
            inside = (points[..., :2] - torch.tensor([1.0, 0.1])).norm(dim=-1) < 0.3
            return torch.where(inside, torch.nan, distance)

    field = Hole(Sphere((50.0, 0.0, 0.0), 1.0), 0.0)
    result = Planner(Disc()).plan(torch.zeros(2), torch.tensor([2.0, 0.0]), field)
    assert result.success, result.message


def test_a_warm_start_is_kept_where_it_is_good_and_gets_the_new_ends():
    pole = Cylinder((1.0, -0.1), 0.3)
    above = Trajectory.through(torch.tensor([[0.0, 0.0], [1.0, -0.7], [2.0, 0.0]]), 40)
    start = torch.tensor([0.05, 0.0])
    cold = Planner(Disc()).plan(start, torch.tensor([2.0, 0.0]), pole)
    warm = Planner(Disc()).plan(start, torch.tensor([2.0, 0.0]), pole, warm_start=above)
    assert cold.success and warm.success
    assert float(cold.trajectory.at(2.5)[1]) > 0 > float(warm.trajectory.at(2.5)[1])
    assert torch.equal(warm.trajectory.waypoints[0], start)


def test_bad_settings_are_refused():
    with pytest.raises(ConfigError, match="num_waypoints"):
        PlannerConfig(num_waypoints=2)
