"""The grid search: whatever way there is, it finds, keeps clear and prefers where there is room."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from planning import ConfigError, Trajectory, TrajectoryError, Validation, WorkspaceConfig, check
from planning.grid_search import Route, grid_search
from planning.position_costs import GridSearchConfig, position_costs
from tests.planning.fields import (
    Box,
    Confident,
    Cylinder,
    HalfSpace,
    NanBeyond,
    Room,
    Sphere,
    Union,
    walls_round,
)
from tests.planning.robots import Base, Disc, PlanarArm

START, GOAL = torch.tensor([0.0, 0.0]), torch.tensor([3.0, 0.0])
FREE = Sphere((0.0, 0.0, 50.0), 0.1)
ROBOT = Disc(radius=0.2)


def length(route: Route) -> float:
    return float(route.path.diff(dim=0).norm(dim=1).sum())


def checked(route: Route, field, robot=ROBOT) -> Validation:
    """The dense check of a route, by code that knows nothing of the grid."""
    return check(robot, Trajectory.through(route.path), field)


@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 4, 1.2, 2.7, -2.0])
def test_free_space_is_crossed_almost_straight(angle: float) -> None:
    start = torch.tensor([0.37, -1.21])
    goal = start + 3.0 * torch.tensor([math.cos(angle), math.sin(angle)])
    route = grid_search(ROBOT, FREE, start, goal)
    assert route.reaches_goal
    assert torch.equal(route.path[0], start) and torch.equal(route.path[-1], goal)
    # Eight directions cost at most 1 / cos(pi / 8) of the straight line; the grid itself a cell more.
    assert 3.0 - 1e-4 <= length(route) <= 3.0 / math.cos(math.pi / 8) + 0.1
    assert route.path.diff(dim=0).norm(dim=1).max() < 0.25, "steps between neighbours only"


OBSTACLES = {
    "pillar": Cylinder((1.5, 0.0), 0.4),
    "wall with a way round one end": Box((1.5, -1.0, 0.5), (0.1, 2.0, 1.0)),
    "two walls": Union(Box((1.0, -1.0, 0.5), (0.1, 1.6, 1.0)), Box((2.0, 1.0, 0.5), (0.1, 1.6, 1.0))),
    "in a room": Union(Room(Box((1.5, 0.0, 1.0), (2.2, 1.5, 1.0))), Cylinder((1.5, 0.3), 0.5)),
}


@pytest.mark.parametrize("name", OBSTACLES)
def test_goes_round_obstacles_and_keeps_clear(name: str) -> None:
    field = OBSTACLES[name]
    straight = Trajectory.through(torch.stack([START, GOAL]))
    assert not check(ROBOT, straight, field).success, "the obstacle is in the way"
    route = grid_search(ROBOT, field, START, GOAL)
    assert route.reaches_goal and torch.equal(route.path[-1], GOAL)
    assert checked(route, field).clearance > 0


def test_a_way_back_to_front_is_as_long() -> None:
    field = OBSTACLES["two walls"]
    there, back = grid_search(ROBOT, field, START, GOAL), grid_search(ROBOT, field, GOAL, START)
    assert length(there) == pytest.approx(length(back), abs=0.15)


def test_the_roomier_gap_is_worth_a_detour() -> None:
    # A wall with a gap that just fits on the straight line, and a wide one 1 m aside.
    robot, edge = Disc(radius=0.2), 0.27
    wall = Union(
        Box((1.5, -3.0 - edge, 0.5), (0.1, 3.0, 1.0)),
        Box((1.5, (edge + 0.7) / 2, 0.5), (0.1, (0.7 - edge) / 2, 1.0)),
        Box((1.5, 5.2, 0.5), (0.1, 3.5, 1.0)),
    )
    cautious = GridSearchConfig(caution=30.0, margin=0.25)
    roomy = grid_search(robot, wall, START, GOAL, cautious)
    hasty = grid_search(robot, wall, START, GOAL, replace(cautious, caution=1.0))
    assert roomy.reaches_goal and hasty.reaches_goal
    assert length(hasty) < 3.3 < length(roomy)
    assert checked(roomy, wall).clearance > checked(hasty, wall).clearance + 0.1 > 0.1


def test_takes_a_narrow_gap_if_there_is_no_other() -> None:
    wall = Union(
        Box((1.5, -5.27, 0.5), (0.1, 5.0, 1.0)),
        Box((1.5, 5.27, 0.5), (0.1, 5.0, 1.0)),
    )
    route = grid_search(ROBOT, wall, START, GOAL)
    assert route.reaches_goal and checked(route, wall).clearance > 0
    assert not grid_search(Disc(radius=0.3), wall, START, GOAL).reaches_goal


def test_a_walled_in_goal_ends_at_the_nearest_reachable_place() -> None:
    field, config = walls_round(3.0), GridSearchConfig()
    route = grid_search(ROBOT, field, START, GOAL, config)
    assert not route.reaches_goal
    assert torch.equal(route.path[0], START)
    assert checked(route, field).clearance >= -0.03
    # The walls' outer faces are 0.6 m from the goal and the robot keeps its radius, to a cell's diagonal.
    gap = float((route.path[-1] - GOAL).norm())
    assert 0.6 + ROBOT.radius - 1e-4 <= gap <= 0.6 + ROBOT.radius + 1.5 * config.spacing


def test_a_goal_inside_an_obstacle_is_not_reached() -> None:
    route = grid_search(ROBOT, Cylinder((3.0, 0.0), 0.5), START, GOAL)
    assert not route.reaches_goal
    assert float((route.path[-1] - GOAL).norm()) == pytest.approx(0.7, abs=0.1)


def test_a_walled_in_start_stays() -> None:
    route = grid_search(ROBOT, walls_round(0.0), START, GOAL)
    assert not route.reaches_goal
    assert route.path.abs().max() < 0.25


def test_a_start_in_collision_escapes() -> None:
    field = Cylinder((-0.25, 0.0), 0.2)  # the robot overlaps it by 0.15 m
    route = grid_search(ROBOT, field, START, GOAL)
    assert route.reaches_goal
    clearance = field.distance(torch.nn.functional.pad(route.path, (0, 1))) - ROBOT.radius
    assert clearance[0] < -0.1
    assert (clearance[(route.path - START).norm(dim=1) > 0.25] >= 0).all()
    stuck = grid_search(ROBOT, field, START, GOAL, GridSearchConfig(escape=0.05))
    assert not stuck.reaches_goal


def test_escaping_never_goes_deeper_into_a_wall() -> None:
    # Planning again and again from where the last route ended must not tunnel through.
    wall = Box((1.0, 0.0, 0.5), (0.5, 9.0, 1.0))
    place = torch.tensor([0.32, 0.0])  # 2 cm in collision
    for _ in range(12):
        route = grid_search(ROBOT, wall, place, GOAL)
        assert not route.reaches_goal
        place = route.path[-1]
    assert place[0] <= 0.32 + 1e-5


def test_nan_is_blocked() -> None:
    route = grid_search(ROBOT, NanBeyond(FREE, 1.0), START, GOAL)
    assert not route.reaches_goal
    assert route.path[:, 0].max() <= 1.0
    assert route.path[-1, 0] > 0.85
    hole = NanBeyond(FREE, -10.0)
    assert not grid_search(ROBOT, hole, START, GOAL).reaches_goal


def test_unknown_space_is_blocked_where_configured() -> None:
    seen = Confident(FREE, seen_below=1.0)
    config = GridSearchConfig(workspace=WorkspaceConfig(unknown_confidence=0.5))
    route = grid_search(ROBOT, seen, START, GOAL, config)
    assert not route.reaches_goal and 0.85 < route.path[:, 0].max() <= 1.0
    assert grid_search(ROBOT, seen, START, GOAL).reaches_goal


def test_a_negative_least_margin_lets_a_map_be_wrong() -> None:
    gap = Union(Box((1.5, -5.15, 0.5), (0.1, 5.0, 1.0)), Box((1.5, 5.15, 0.5), (0.1, 5.0, 1.0)))
    assert not grid_search(ROBOT, gap, START, GOAL).reaches_goal
    assert grid_search(ROBOT, gap, START, GOAL, GridSearchConfig(least_margin=-0.1)).reaches_goal


def test_the_floor_is_no_obstacle_for_wheels() -> None:
    class Wheels(Disc):
        floor_spheres = torch.tensor([True])

    floor = HalfSpace()
    assert not grid_search(Disc(0.2, height=0.1), floor, START, GOAL).reaches_goal
    assert grid_search(Wheels(0.2, height=0.1), floor, START, GOAL).reaches_goal


def test_start_and_goal_the_same() -> None:
    route = grid_search(ROBOT, FREE, START, START.clone())
    assert route.reaches_goal
    assert len(route.path) >= 1 and torch.equal(route.path, torch.zeros_like(route.path))


def test_start_and_goal_within_a_cell() -> None:
    goal = torch.tensor([0.03, -0.02])
    route = grid_search(ROBOT, FREE, START, goal)
    assert route.reaches_goal and torch.equal(route.path[-1], goal) and length(route) < 0.05


def test_double_precision() -> None:
    route = grid_search(ROBOT, OBSTACLES["pillar"], START.double(), GOAL.double())
    assert route.reaches_goal and route.path.dtype == torch.float64


@pytest.mark.parametrize("robot", [Base(), PlanarArm((0.5, 0.5, 0.5))])
def test_another_number_of_joints_is_refused(robot) -> None:
    with pytest.raises(TrajectoryError, match=r"2 joints.*got 3"):
        grid_search(robot, FREE, START, GOAL)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_goal_that_is_no_place_is_refused(bad: float) -> None:
    with pytest.raises(TrajectoryError, match="finite"):
        grid_search(ROBOT, FREE, START, torch.tensor([bad, 0.0]))


@pytest.mark.parametrize(
    "values",
    [
        {"spacing": 0.0},
        {"spacing": -0.1},
        {"padding": 0.0},
        {"margin": 0.1, "least_margin": 0.1},
        {"margin": -0.2},
        {"caution": 0.5},
        {"through_passing": 0.5},
        {"through_passing": math.nan},
        {"through_guessed": 0.5},
    ],
)
def test_bad_settings_are_refused(values: dict) -> None:
    with pytest.raises(ConfigError, match="GridSearchConfig"):
        GridSearchConfig(**values)


# A wall across the way with a doorway at y = 1.5, and the space behind it taken for solid but for a tongue.
DOORWAY = Union(
    Box((1.5, -2.1, 0.5), (0.1, 3.0, 1.0)),
    Box((1.5, 5.1, 0.5), (0.1, 3.0, 1.0)),
    Box((3.5, -2.25, 0.5), (2.0, 2.75, 1.0)),
)
EXPLORING = GridSearchConfig(through_blocked=30.0)


def test_where_no_free_way_leads_on_the_route_ends_before_the_cheapest_blocked_way() -> None:
    assert not grid_search(ROBOT, DOORWAY, START, GOAL).reaches_goal
    route = grid_search(ROBOT, DOORWAY, START, GOAL, EXPLORING)
    assert not route.reaches_goal and route.entry is not None
    assert float(route.path[-1, 0]) > 2.0, "through the doorway, not up to the wall"
    assert checked(route, DOORWAY).clearance > -0.03
    gap = float((route.entry - route.path[-1]).norm())
    assert gap < 1.5 * EXPLORING.spacing, "the entry is the next cell"
    assert float(DOORWAY.distance(torch.nn.functional.pad(route.entry, (0, 1)))) < ROBOT.radius


def test_closed_places_send_the_route_elsewhere_and_in_the_end_nowhere() -> None:
    goal, closed, entries = torch.tensor([3.0, -1.5]), torch.zeros(0, 2), []
    for _ in range(60):
        route = grid_search(ROBOT, DOORWAY, START, goal, EXPLORING, closed)
        if route.entry is None:
            break
        if len(closed):
            assert float((closed - route.entry).norm(dim=1).min()) > 0.99 * EXPLORING.closed_radius
        entries.append(route.entry)
        closed = torch.stack(entries)
    assert len(entries) > 2 and route.entry is None
    nearest = grid_search(ROBOT, DOORWAY, START, goal)
    torch.testing.assert_close(route.path[-1], nearest.path[-1])


def test_a_free_way_is_never_given_up_for_a_shorter_blocked_one() -> None:
    wall = Box((1.5, 0.0, 0.5), (0.1, 2.0, 1.0))
    route = grid_search(ROBOT, wall, START, GOAL, replace(EXPLORING, through_blocked=1.0))
    assert route.reaches_goal and checked(route, wall).clearance > 0


# A wall that was seen, and what the field guesses beyond its end: solid, too, and thick.
SEEN_WALL, GUESSED = Box((1.5, 0.0, 0.5), (0.1, 2.0, 1.0)), Box((1.5, 4.2, 0.5), (0.4, 2.2, 1.0))


class Surveyed(Union):
    """It knows that it only guesses one of its parts."""

    def surface_seen(self, points: torch.Tensor) -> torch.Tensor:
        return SEEN_WALL.distance(points) < GUESSED.distance(points)


@pytest.mark.parametrize(("price", "guessed"), [(3.0, True), (30.0, False), (math.inf, False)])
def test_to_go_and_see_what_is_guessed_is_worth_a_detour(price: float, guessed: bool) -> None:
    below = Box((1.5, -7.0, 0.5), (0.1, 5.5, 1.0))
    field = Surveyed(SEEN_WALL, below, GUESSED)
    route = grid_search(ROBOT, field, START, GOAL, replace(EXPLORING, through_guessed=price))
    assert not route.reaches_goal and route.entry is not None
    assert checked(route, field).clearance > -0.03
    assert (float(route.entry[1]) > 1.5) == guessed, "a guess costs no more than a wall"
    blind = grid_search(
        ROBOT, Union(SEEN_WALL, below, GUESSED), START, GOAL, replace(EXPLORING, through_guessed=price)
    )
    assert abs(float(blind.entry[1])) < 1.0, "fields that do not tell are taken at their word"


def test_where_a_field_is_nan_it_guesses_nothing() -> None:
    class Broken(Union):
        def surface_seen(self, points: torch.Tensor) -> torch.Tensor:
            return torch.ones(points.shape[:-1], dtype=torch.bool)

    config, at = replace(EXPLORING, through_guessed=3.0), torch.tensor([[0.0, 0.0], [2.0, 0.0]])
    prices = position_costs(ROBOT, Broken(NanBeyond(FREE, 1.5)), at, START, config, None).price
    assert float(prices[0]) == 1.0 and float(prices[1]) == config.through_blocked


# A wall with a passage on the way, in which somebody stands, and a way round its end.
PASSAGE = Union(Box((1.5, 1.5, 0.5), (0.1, 1.0, 1.0)), Box((1.5, -3.5, 0.5), (0.1, 3.0, 1.0)))
SOMEBODY = Box((1.5, 0.0, 0.5), (0.2, 0.5, 1.0))


@pytest.mark.parametrize(("price", "waits"), [(1.0, True), (3.0, True), (20.0, False)])
def test_what_is_passing_is_let_pass_unless_the_way_round_is_short(price: float, waits: bool) -> None:
    def passing(places: torch.Tensor, deepest: torch.Tensor) -> torch.Tensor:
        assert places.shape[1] == 2 and deepest.shape == (len(places), 3)
        return SOMEBODY.distance(deepest) <= PASSAGE.distance(deepest)

    field, config = Union(PASSAGE, SOMEBODY), replace(EXPLORING, through_passing=price)
    route = grid_search(ROBOT, field, START, GOAL, config, None, passing)
    assert route.reaches_goal != waits and checked(route, field).clearance > -0.03
    if not waits:
        assert float(route.path[:, 1].max()) > 2.5
        return
    assert route.entry is not None and abs(float(route.entry[1])) < 0.5
    around = grid_search(ROBOT, field, START, GOAL, config, route.entry[None], passing)
    assert around.reaches_goal, "closed to what is passing, too"
    assert grid_search(ROBOT, field, START, GOAL, config).reaches_goal, "nothing is passing"


def test_what_is_always_there_never_passes() -> None:
    route = grid_search(
        ROBOT, PASSAGE, START, GOAL, EXPLORING, None, lambda places, _: torch.zeros(len(places)).bool()
    )
    assert route.reaches_goal and checked(route, PASSAGE).clearance > 0


def test_room_is_left_where_the_robot_stands_far_enough_aside() -> None:
    """A corridor, shut at its far end, opens into free space at x = 1.5."""
    corridor = Union(
        Box((3.0, 0.8, 0.5), (1.5, 0.1, 1.0)),
        Box((3.0, -0.8, 0.5), (1.5, 0.1, 1.0)),
        Box((4.5, 0.0, 0.5), (0.1, 0.9, 1.0)),
    )
    before, goal = torch.tensor([1.0, 0.0]), torch.tensor([4.0, 0.0])
    route = grid_search(ROBOT, corridor, before, goal)
    grid, way = route.grid, route.path
    assert 0.5 < grid.room(way, before, 1.0) < 3.0, "the corridor but for its mouth"
    assert grid.room(way, torch.tensor([-0.5, 0.0]), 1.0) > 20.0
    assert grid.room(way[:3], before, 1.0) == 0.0, "all of it is within a metre of the robot"
    assert grid.room(torch.tensor([[3.0, 0.8]]), before, 1.0) == math.inf, "inside the wall"
    assert grid.room(torch.cat([way, torch.tensor([[4.0, 2.0]])]), before, 1.0) > 20.0, "the largest counts"
    path = grid.nearest_with_room(before, way, 1.0, 6.0)
    assert torch.equal(path[0], before) and grid.room(way, path[-1], 1.0) > 6.0
    assert 0.2 < float(path.diff(dim=0).norm(dim=1).sum()) < 1.5
    inside = torch.tensor([3.9, 0.0])
    assert len(grid.nearest_with_room(inside, way, 9.0, 6.0)) == 1, "nowhere"
