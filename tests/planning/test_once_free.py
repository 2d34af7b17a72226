"""What comes into the way is told from what was always there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from planning.base_planner import BasePlanner, BasePlannerConfig
from planning.drive import DriveStatus
from planning.grid_search import grid_search
from planning.once_free import OnceFree
from planning.position_costs import GridSearchConfig
from planning.vain_looks import LONG, OUT_OF_WAY
from tests.planning.fields import Box, Cylinder, Union
from tests.planning.robots import Disc
from tests.planning.test_replanning import BODY, FREE, QUICK, drive
from tests.planning.unicycles import Unicycle

START, GOAL = torch.zeros(2), torch.tensor([4.0, 0.0])
BARRIER = Box((2.0, 0.0, 0.5), (0.3, 30.0, 1.0))
"""It leaves no way round."""


def test_cells_are_remembered_on_both_sides_of_the_origin() -> None:
    free = OnceFree(0.1)
    for _ in range(2):
        free.add(torch.tensor([[-1.32, 2.0], [0.04, -0.04], [3.0, -7.1]]))
    places = torch.tensor([[-1.3, 1.96], [-0.04, 0.0], [3.0, -7.06], [1.3, 2.0], [0.7, 0.0], [3.0, 7.1]])
    assert free.were(places).tolist() == [True] * 3 + [False] * 3


def test_the_way_back_leads_far_enough_and_no_farther() -> None:
    grid = grid_search(BODY, BARRIER, torch.tensor([1.4, 0.0]), GOAL).grid
    place = torch.tensor([1.6, 0.0])
    path = grid.way_back(torch.tensor([1.4, 0.0]), place, 1.0)
    torch.testing.assert_close(path[0], torch.tensor([1.4, 0.0]))
    assert 1.0 <= float((path[-1] - place).norm()) < 1.15
    shut_in = replace(grid, cost=torch.where((grid.positions - path[0]).norm(dim=1) < 0.35, 1.0, torch.inf))
    nook = shut_in.way_back(path[0], place, 1.0)
    assert 0.45 < float((nook[-1] - place).norm()) < 0.6, "as far as can be"


def test_a_plan_keeps_off_what_came_and_goes_up_to_what_was_there() -> None:
    was_there = BasePlanner(BODY).plan(START, GOAL, BARRIER)
    assert was_there.usable and not was_there.came
    planner = BasePlanner(BODY)
    assert planner.plan(START, GOAL, FREE).reaches_goal
    came = planner.plan(START, GOAL, BARRIER, now=1.0)
    assert came.usable and came.came and not came.reaches_goal
    gaps = [float((p.onward[0] - p.result.trajectory.waypoints[-1]).norm()) for p in (was_there, came)]
    assert gaps[0] < 0.2 and 1.0 <= gaps[1] < 1.2


def test_a_wall_whose_edge_shifts_has_not_come() -> None:
    planner = BasePlanner(BODY)
    for shift in (0.15, 0.0):
        plan = planner.plan(START, GOAL, Box((2.0 + shift, 0.0, 0.5), (0.3, 30.0, 1.0)))
    assert not plan.reaches_goal and not plan.came


def test_too_near_to_what_came_it_waits_where_it_is_however_often_it_looks() -> None:
    planner, near = BasePlanner(BODY), torch.tensor([1.4, 0.0])
    planner.plan(near, GOAL, FREE)
    for now in (1.0, 3.0, 5.0):
        plan = planner.plan(near, GOAL, BARRIER, now=now)
        assert plan.dead_end and plan.came and "came into the way" in plan.reason


def test_where_no_other_way_is_left_it_waits_for_what_came_again() -> None:
    search = GridSearchConfig(through_blocked=30.0, closed_radius=30.0)
    planner, near = (
        BasePlanner(BODY, BasePlannerConfig(search=search, looks_came=1)),
        torch.tensor([1.4, 0.0]),
    )
    planner.plan(near, GOAL, FREE)
    first, second = (planner.plan(near, GOAL, BARRIER, now=now) for now in (1.0, 3.0))
    assert len(first.onward) and torch.equal(first.onward, second.onward)
    assert first.came and second.came and second.dead_end


@dataclass
class Knowing(Box):
    """A box that knows from which x [m] on it came lately."""

    since: float = 0.0

    def observed(self, points: torch.Tensor) -> torch.Tensor:
        return torch.ones(points.shape[:-1], dtype=torch.bool)

    def came(self, points: torch.Tensor) -> torch.Tensor:
        return points[..., 0] > self.since


@pytest.mark.parametrize(("since", "came"), [(1.0, True), (3.0, False)])
def test_what_the_field_knows_to_have_come_is_kept_off_though_nothing_was_free_there(
    since: float, came: bool
) -> None:
    barrier = Knowing((2.0, 0.0, 0.5), (0.3, 30.0, 1.0), since)
    plan = BasePlanner(BODY).plan(START, GOAL, barrier)
    assert plan.came == came
    gap = float((plan.onward[0] - plan.result.trajectory.waypoints[-1]).norm())
    assert 1.0 <= gap < 1.2 if came else gap < 0.2


# A wall with a passage on the way, in which somebody stands from some x on, and a way round its end.
WALL = Union(Box((2.0, 1.5, 0.5), (0.1, 0.8, 1.0)), Box((2.0, -31.0, 0.5), (0.1, 30.3, 1.0)))


class Passage(Union):
    """The wall, perhaps with somebody in the passage; what is in the passage came there, or was always there."""

    def __init__(self, *parts, came: bool = False) -> None:
        super().__init__(*parts)
        self.came_there = came

    def observed(self, points: torch.Tensor) -> torch.Tensor:
        return torch.ones(points.shape[:-1], dtype=torch.bool)

    def came(self, points: torch.Tensor) -> torch.Tensor:
        return (points[..., 1].abs() < 0.6) & torch.tensor(self.came_there)


@pytest.mark.parametrize("came", [True, False])
@pytest.mark.parametrize("before", [True, False])
def test_who_came_into_the_way_is_waited_for_though_there_is_a_way_round(came: bool, before: bool) -> None:
    planner, person = BasePlanner(BODY), Box((2.0, 0.0, 0.5), (0.2, 0.5, 1.0))
    if before:
        assert planner.plan(START, GOAL, Passage(WALL)).reaches_goal
    plan = planner.plan(START, GOAL, Passage(WALL, person, came=came), now=1.0)
    assert plan.usable and plan.reaches_goal != came
    if came:
        assert plan.blocker is not None and plan.came
        assert float(person.distance(torch.tensor([*plan.blocker.tolist(), 0.5])).abs()) < 0.1


def test_who_came_is_waited_for_rather_than_unknown_space_entered_beside_him() -> None:
    """Between x = 1 and 3 somebody is everywhere up to y = 0; what is beyond that is unknown, and so is the goal."""

    class Beside(Box):
        def observed(self, points: torch.Tensor) -> torch.Tensor:
            known = (points[..., 1] < 0.0) | ((points[..., 0] - 2.0).abs() > 1.0)
            return known & (points[..., 0] < 4.0)

        def came(self, points: torch.Tensor) -> torch.Tensor:
            return torch.ones(points.shape[:-1], dtype=torch.bool)

    start, goal = torch.tensor([-1.0, 0.9]), torch.tensor([5.0, 0.9])
    plan = BasePlanner(BODY).plan(start, goal, Beside((2.0, -30.0, 0.5), (1.0, 30.0, 1.0)))
    onward = plan.onward[(plan.onward[:, 0] - 2.0).abs() < 0.9, 1]
    assert plan.usable and len(onward) and float(onward.max()) < 0.3


class Ring(Disc):
    """A disc made of small spheres, which can be cut by several things."""

    def spheres(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Twelve spheres on a circle and one in the middle."""
        turns = torch.arange(12).to(q) * math.pi / 6
        offsets = self.radius * torch.stack([turns.cos(), turns.sin(), 0 * turns], dim=1)
        offsets = torch.cat([torch.zeros(1, 3).to(q), 0.75 * offsets])
        middle, _ = super().spheres(q)
        return middle + offsets, torch.full((13,), 0.25 * self.radius).to(q)


@pytest.mark.parametrize("half_width", [0.15, 0.6])
def test_who_stands_in_a_gap_too_narrow_for_the_base_is_not_waited_for(half_width: float) -> None:
    jambs = [Box((2.0, y * (half_width + 0.8), 0.5), (0.1, 0.8, 1.0)) for y in (-1, 1)]
    person = Box((2.0, 0.0, 0.5), (0.3, 0.14, 1.0))

    class Gap(Passage):
        def came(self, points: torch.Tensor) -> torch.Tensor:
            return person.distance(points).abs() < 0.005

    plan = BasePlanner(Ring(radius=0.25)).plan(START, GOAL, Gap(*jambs, person))
    assert plan.usable and plan.came == (not plan.reaches_goal) == (half_width > 0.3)


# A dead end 1.6 m wide that opens at x = 1, and somebody in its mouth.
NOOK = Union(
    *(Box((2.2, y, 0.5), (1.2, 0.1, 1.0)) for y in (-0.9, 0.9)), Box((3.4, 0.0, 0.5), (0.1, 1.0, 1.0))
)


class Entered(Union):
    """The walls, perhaps with somebody who came."""

    def observed(self, points: torch.Tensor) -> torch.Tensor:
        return torch.ones(points.shape[:-1], dtype=torch.bool)

    def came(self, points: torch.Tensor) -> torch.Tensor:
        return (points[..., 0] < 2.0) & (points[..., 1].abs() < 0.5)


@pytest.mark.parametrize("shut_in", [True, False])
def test_who_is_shut_in_by_the_robot_is_given_room_once(shut_in: bool) -> None:
    walls = NOOK if shut_in else Union(*NOOK.parts[:2])
    person, goal, near = Cylinder((1.6, 0.0), 0.3), torch.tensor([2.8, 0.0]), torch.tensor([0.1, 0.0])
    planner, occupied = BasePlanner(BODY), Entered(walls, person)
    planner.plan(near, goal, Entered(walls))
    plans = [planner.plan(near, goal, occupied, now=1.0 + n) for n in range(5)]
    assert [plan.dead_end for plan in plans] == 4 * [True] + [not shut_in]
    if not shut_in:
        return
    back, route = plans[-1].result.trajectory.waypoints[-1], planner.route(near, goal, occupied)
    rooms = [route.grid.room(route.onward, place, 1.0) for place in (near, back)]
    assert rooms[0] < 3.0 < 20.0 < rooms[1]
    assert planner.plan(back, goal, occupied, now=10.0).dead_end, "it stays there"
    far = planner.route(torch.tensor([-2.5, 0.0]), goal, occupied)
    assert not planner.leads_on(planner.route(back, goal, occupied), occupied, 10.0)
    assert planner.leads_on(far, occupied, 27.0)


def test_who_stays_for_long_is_given_room_whatever_the_map_says() -> None:
    """Of two walls no end is known: there seems to be a way round."""
    walls = Union(*NOOK.parts[:2])
    person, goal, near = Cylinder((1.6, 0.0), 0.3), torch.tensor([2.8, 0.0]), torch.tensor([0.1, 0.0])
    planner, occupied = BasePlanner(BODY), Entered(walls, person)
    planner.plan(near, goal, Entered(walls))
    plans = [planner.plan(near, goal, occupied, now=1.0 + n) for n in range(LONG + 1)]
    assert [plan.dead_end for plan in plans] == LONG * [True] + [False]
    back = plans[-1].result.trajectory.waypoints[-1]
    assert 2.9 < float((back - plans[-1].onward[0]).norm()) < 3.3
    assert planner.plan(back, goal, occupied, now=20.0).dead_end, "it stays there"


def test_who_stands_at_the_goal_beside_the_robot_is_given_room() -> None:
    """In the dead end, where all that is left of the way is within a metre of the robot."""
    planner, person = BasePlanner(BODY), Cylinder((2.95, 0.0), 0.3)
    near, goal = torch.tensor([2.2, 0.0]), torch.tensor([2.8, 0.0])

    class Met(Entered):
        def came(self, points: torch.Tensor) -> torch.Tensor:
            return person.distance(points).abs() < 0.1

    planner.plan(near, goal, Met(NOOK))
    plans = [planner.plan(near, goal, Met(NOOK, person), now=1.0 + n) for n in range(5)]
    assert [plan.dead_end for plan in plans] == 4 * [True] + [False]
    assert float((plans[-1].result.trajectory.waypoints[-1] - goal).norm()) > 1.3


@pytest.mark.parametrize(("price", "off"), [(2.0, 1.2), (1.5, OUT_OF_WAY)])
@pytest.mark.parametrize("shut_in", [True, False])
def test_it_waits_where_it_shuts_in_nobody(shut_in: bool, price: float, off: float) -> None:
    walls = NOOK if shut_in else Union(*NOOK.parts[:2])
    person, goal, far = Cylinder((1.6, 0.0), 0.3), torch.tensor([2.8, 0.0]), torch.tensor([-2.0, 0.0])
    config = BasePlannerConfig()
    config = replace(config, search=replace(config.search, through_passing=price))
    planner, occupied = BasePlanner(BODY, config), Entered(walls, person)
    planner.plan(far, goal, Entered(walls))
    plan, route = planner.plan(far, goal, occupied, now=1.0), planner.route(far, goal, occupied)
    end = plan.result.trajectory.waypoints[-1]
    assert plan.usable and route.grid.room(route.onward, end, off) > 20.0
    assert (float((end - plan.onward[0]).norm()) < 1.2) != shut_in
    assert not planner.leads_on(planner.route(end, goal, occupied), occupied, 2.0)


def test_the_robot_waits_for_what_came_and_goes_on_when_it_is_gone() -> None:
    robot, waited_at = Unicycle(), []
    shut = Box((2.0, 0.0, 0.5), (0.3, 1000.0, 1.0))

    def knows():
        there = 3.0 < robot.time < 20.0
        if 12.0 < robot.time < 20.0:
            waited_at.append(float(robot.state[0]))
        return shut if there else FREE

    config = replace(QUICK, planner=BasePlannerConfig(), patience=15, time_limit=90.0)
    _, report = drive(robot, knows, config, goal=GOAL.double().numpy())
    assert report.success, report.message
    assert any("came into the way" in event for event in report.events)
    assert waited_at and max(waited_at) < 0.8, "as near as it may come"
    assert robot.time < 40.0


def test_it_goes_on_as_soon_as_what_came_has_gone() -> None:
    robot = Unicycle()
    shut = Box((2.0, 0.0, 0.5), (0.3, 1000.0, 1.0))
    config = replace(QUICK, planner=BasePlannerConfig(), patience=15, wait=30.0, time_limit=90.0)
    _, report = drive(
        robot, lambda: shut if 3.0 < robot.time < 20.0 else FREE, config, goal=GOAL.double().numpy()
    )
    assert report.success and any("came into the way" in event for event in report.events)
    assert robot.time < 33.0


def test_it_follows_what_came_and_has_walked_on() -> None:
    robot = Unicycle()
    goal, near, far = (6.0, 0.0), *(Box((x, 0.0, 0.5), (0.3, 1000.0, 1.0)) for x in (2.0, 5.0))
    config = replace(QUICK, planner=BasePlannerConfig(), patience=15, wait=60.0, time_limit=40.0)
    drive(
        robot,
        lambda: FREE if robot.time < 3.0 else near if robot.time < 10.0 else far,
        config,
        goal=np.array(goal),
    )
    assert 3.0 < robot.state[0] < 4.0, "not all the way is free, but the next part"


def test_a_way_that_opens_for_a_moment_only_is_not_taken_for_driven() -> None:
    robot, opened = Unicycle(), []
    shut = Box((5.0, 0.0, 0.5), (0.3, 1000.0, 1.0))
    config = replace(QUICK, planner=BasePlannerConfig(), wait=30.0, time_limit=25.0)

    def knows():
        if robot.time > 18.0 and not opened:
            opened.append(robot.time)
            return FREE
        return shut if robot.time > 3.0 else FREE

    loop, report = drive(robot, knows, config, goal=np.array([6.0, 0.0]))
    assert opened and loop.report.failed_plans > 1 and not report.success
    assert report.goal_distance > 1.0


def test_what_came_and_stays_is_given_up() -> None:
    robot = Unicycle()
    config = replace(QUICK, planner=BasePlannerConfig(), time_limit=200.0)
    shut = Box((2.0, 0.0, 0.5), (0.3, 1000.0, 1.0))
    # It comes before the robot is where it comes to.
    _, report = drive(robot, lambda: shut if robot.time > 4.5 else FREE, config, goal=GOAL.double().numpy())
    assert report.status is DriveStatus.UNREACHABLE, report.message
    assert robot.state[0] < 1.7 - BODY.radius


@pytest.mark.parametrize("came", [True, False])
def test_a_goal_is_not_unreachable_because_somebody_walks_about_in_the_way(came: bool) -> None:
    somebody = Knowing((2.0, 0.0, 0.5), (0.3, 1000.0, 1.0), since=1.0 if came else 3.0)
    config = replace(QUICK, planner=BasePlannerConfig(), wait=1.0, time_limit=20.0)
    _, report = drive(Unicycle(), somebody, config, goal=GOAL.double().numpy())
    assert report.failed_plans > config.patience
    assert report.status is (DriveStatus.TIME_LIMIT if came else DriveStatus.UNREACHABLE), report.message
    assert not came or any("something came into the way" in event for event in report.events)


@pytest.mark.parametrize(
    "values",
    [
        {"looks_came": 0},
        {"stand_off": -0.1},
        {"wary": -0.01},
        {"wary": math.nan},
    ],
)
def test_bad_ways_of_waiting_are_refused(values: dict) -> None:
    with pytest.raises(Exception, match=next(iter(values))):
        BasePlannerConfig(**values)


@pytest.mark.parametrize(("came", "looks"), [(False, 3), (True, 8)])
def test_other_places_are_tried_later_where_something_came(came: bool, looks: int) -> None:
    planner, near = BasePlanner(BODY, BasePlannerConfig(stand_off=0.0)), torch.tensor([1.4, 0.0])
    if came:
        planner.plan(near, GOAL, FREE)
    tries = [planner.plan(near, GOAL, BARRIER, now=1.0 + n) for n in range(looks + 1)]
    entries = torch.stack([plan.onward[0] for plan in tries])
    assert (entries[:looks] - entries[0]).norm(dim=1).max() < 0.3
    assert (entries[looks] - entries[0]).norm() > 0.5
