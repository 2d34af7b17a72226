"""Space that nobody has looked at is not driven into."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from planning.base_planner import BasePlanner, BasePlannerConfig
from planning.drive import DriveStatus
from planning.explored import ExploredField, Trodden
from planning.gaze import Gaze, GazeConfig
from planning.grid_search import grid_search
from planning.position_costs import GridSearchConfig
from planning.protocols import ChangingField, ObservingField, SurveyedField
from planning.replanning import ReplanningLoop
from planning.trajectory import Trajectory
from planning.workspace import WorkspaceConfig
from tests.planning.fields import AutogradField, Box, Confident, Cylinder, Union
from tests.planning.test_replanning import BODY, FREE, QUICK, drive
from tests.planning.unicycles import Unicycle

START = torch.zeros(2)
TRAIL = ((0.0, 0.0, 0.5), (1.0, 0.0, 0.45))


def trodden(*discs: tuple[float, float, float]) -> Trodden:
    """Discs x, y, radius [m] that the base has been in."""
    been = Trodden()
    for x, y, radius in discs:
        been.add(np.array([x, y]), radius)
    return been


@dataclass
class Observed(AutogradField):
    """A field of which only what is near to some places was looked at."""

    field: AutogradField
    places: Tensor
    reach: float

    def distance(self, points: Tensor) -> Tensor:
        return self.field.distance(points)

    def observed(self, points: Tensor) -> Tensor:
        return (
            torch.cdist(points.reshape(-1, 3)[:, :2].float(), self.places).amin(dim=1).view(points.shape[:-1])
            <= self.reach
        )


def test_known_is_what_was_looked_at_and_where_the_base_has_been() -> None:
    seen = Observed(FREE, torch.tensor([[5.0, 0.0]]), 1.0)
    assert isinstance(seen, ObservingField)
    explored = ExploredField(seen, trodden(*TRAIL))
    at = torch.tensor(
        [[5.5, 0.0, 0.3], [0.0, 0.4, 9.0], [1.4, 0.0, 0.1], [0.52, 0.3, 0.1], [1.6, 0.0, 0.1], [-3, 9, 0.0]]
    )
    assert explored.confidence(at).tolist() == [1, 1, 1, 0, 0, 0]
    assert explored.confidence(at.view(2, 3, 3)).shape == (2, 3)
    assert torch.equal(explored.distance(at), FREE.distance(at))
    assert torch.equal(explored.distance_and_gradient(at)[1], FREE.distance_and_gradient(at)[1])


def test_a_confidence_tells_as_well_what_was_looked_at() -> None:
    explored = ExploredField(Confident(FREE, 2.0), trodden(*TRAIL))
    assert explored.confidence(torch.tensor([[1.9, 3.0, 0.0], [2.1, 3.0, 0.0]])).tolist() == [1, 0]


def test_a_surface_was_seen_where_the_field_is_sure_of_it_wherever_one_asks() -> None:
    walls = Union(Box((1.0, 0.0, 0.5), (0.05, 9.0, 9.0)), Box((3.0, 0.0, 0.5), (0.05, 9.0, 9.0)))
    at = torch.tensor([[0.3, 0.0, 0.5], [1.8, 0.0, 0.5], [2.2, 0.0, 0.5], [3.0, 0.0, 0.5]])
    sure, telling = ExploredField(Confident(walls, 1.5), Trodden()), Observed(walls, torch.zeros(1, 2), 1.0)
    assert isinstance(sure, SurveyedField)
    assert sure.surface_seen(at).tolist() == [True, True, False, False]
    assert sure.surface_seen(at.view(2, 2, 3)).shape == (2, 2)
    assert ExploredField(telling, Trodden()).surface_seen(at).all(), "it does not tell how sure it is"


@pytest.mark.parametrize("seen", [Observed(FREE, torch.zeros(1, 2), 1.0), Confident(FREE, 1.0)])
def test_a_plan_ends_before_space_that_was_not_looked_at(seen) -> None:
    plan = BasePlanner(BODY).plan(START, torch.tensor([3.0, 0.0]), seen)
    assert plan.usable and not plan.reaches_goal
    ends = plan.result.trajectory.waypoints
    centres, _ = BODY.spheres(ends)
    assert bool(ExploredField(seen, trodden((0.0, 0.0, 0.5))).confidence(centres).all())
    assert 0.7 < float(ends[-1, 0]) <= 1.0
    torch.testing.assert_close(plan.onward[-1], torch.tensor([3.0, 0.0]), atol=0.06, rtol=0)


def test_a_seen_detour_is_taken_rather_than_a_short_cut_that_was_not_seen() -> None:
    way = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 1.5], [2.0, 1.5], [3.0, 1.0], [3.0, 0.0]])
    points = torch.cat([a + torch.linspace(0, 1, 20)[:, None] * (b - a) for a, b in itertools.pairwise(way)])
    plan = BasePlanner(BODY).plan(START, torch.tensor([3.0, 0.0]), Observed(FREE, points, 0.4))
    assert plan.usable and plan.reaches_goal
    assert float(plan.result.trajectory.waypoints[:, 1].max()) > 0.9


@pytest.mark.parametrize(("price", "least", "most"), [(1.0, -0.3, 0.3), (2.0, 0.8, 1.6)])
def test_the_way_through_unknown_space_has_its_price(price: float, least: float, most: float) -> None:
    class Seen(Confident):
        def confidence(self, points: Tensor) -> Tensor:
            hidden = (points[..., 0] > 1.0) & (points[..., 0] < torch.where(points[..., 1] < 1.0, 3.0, 1.4))
            return (~hidden).to(points)

    config = GridSearchConfig(through_unknown=price, workspace=WorkspaceConfig(unknown_confidence=0.5))
    route = grid_search(BODY, Seen(FREE, 0.0), START, torch.tensor([4.0, 0.0]), config)
    assert not route.reaches_goal and least < float(route.onward[0, 1]) < most
    assert torch.equal(route.entry, route.onward[0])


def test_the_way_leads_round_a_wall_that_was_seen_however_narrow_unseen_space_is_guessed_to_be() -> None:
    wall = Box((2.0, 0.0, 0.5), (0.05, 2.0, 1.0))

    class Seen(Confident):
        def distance(self, points: Tensor) -> Tensor:
            guess = torch.where(points[..., 0] > 1.2, 0.3, 9.0).to(points)
            return torch.minimum(wall.distance(points), guess)

        def confidence(self, points: Tensor) -> Tensor:
            return (points[..., 0] < 1.2).to(points)

    config = BasePlannerConfig().search
    route = grid_search(BODY, Seen(wall, 0.0), START, torch.tensor([4.0, 0.0]), config)
    assert not route.reaches_goal
    way = torch.cat([route.path, route.onward])
    assert float(wall.distance(torch.cat([way, torch.full((len(way), 1), 0.3)], dim=1)).min()) > 0.1


@pytest.mark.parametrize(
    ("far", "most", "waypoints"), [(0.6, 40, 12), (3.0, 40, 31), (9.0, 40, 40), (3.0, 5, 5)]
)
def test_a_plan_has_as_many_waypoints_as_its_length_asks_for(far: float, most: int, waypoints: int) -> None:
    planner = BasePlanner(BODY, BasePlannerConfig(num_waypoints=most, spacing=0.1001))
    plan = planner.plan(START, torch.tensor([far, 0.0]), FREE)
    assert plan.reaches_goal and len(plan.result.trajectory) == waypoints


def test_a_field_that_does_not_tell_is_taken_at_its_word() -> None:
    assert BasePlanner(BODY).plan(START, torch.tensor([3.0, 0.0]), FREE).reaches_goal


def test_dead_ends_are_tried_again_after_a_while() -> None:
    planner = BasePlanner(BODY, BasePlannerConfig(memory=30.0))
    wall, goal = Box((0.6, 0.0, 0.5), (0.3, 30.0, 1.0)), torch.tensor([3.0, 0.0])
    here = START
    for now in range(10):
        plan = planner.plan(here, goal, wall, now=float(now))
        here = plan.result.trajectory.waypoints[-1] if plan.usable else here
    closed = [
        len(planner.plan(START, goal, wall, now=now).onward) and float(plan.onward[0, 1])
        for now in (10.0, 60.0)
    ]
    fresh = BasePlanner(BODY).plan(START, goal, wall).onward
    again = planner.plan(START, goal, wall, now=200.0).onward
    assert closed[0] != float(fresh[0, 1]), "closed for now"
    torch.testing.assert_close(again, fresh)


def test_what_does_not_show_itself_from_close_by_is_looked_at_from_farther_off() -> None:
    """As space does at the robot's feet: its camera sees it only from some way off."""
    robot, goal = Unicycle(), np.array([2.0, 0.0])
    seen = torch.tensor([[-1.5, 0.0], [-0.5, 0.0], [0.5, 0.0]])
    nearest, found = [math.inf], [False]

    def knows():
        gap = 2.0 - float(robot.state[0])
        nearest[0] = min(nearest[0], gap)
        found[0] = found[0] or (nearest[0] < 1.0 and gap > 1.2)
        return Observed(FREE, torch.cat([seen, torch.tensor([[2.0, 0.0]])]) if found[0] else seen, 1.1)

    config = replace(QUICK, planner=BasePlannerConfig(), patience=6)
    _, report = drive(robot, knows, config, goal=goal)
    assert report.success, report.message
    assert found[0]


def test_the_robot_drives_only_where_it_has_looked_and_still_arrives() -> None:
    robot, looked = Unicycle(), []

    def knows():
        # It sees a disc about a metre ahead, wherever it was.
        x, y, yaw = robot.state
        looked.append([x + math.cos(yaw), y + math.sin(yaw)])
        return Observed(FREE, torch.tensor(looked, dtype=torch.float32), 0.9)

    plans = []

    def watch(loop: ReplanningLoop) -> None:
        if loop.plan is not None:
            centres, _ = BODY.spheres(loop.plan.trajectory.waypoints)
            been = [(float(x), float(y), 0.16) for x, y, _ in robot.states[::20]]
            trail = trodden((*robot.states[0][:2], 0.56), *been)
            plans.append(bool(ExploredField(loop.field, trail).confidence(centres).all()))

    _loop, report = drive(robot, knows, replace(QUICK, planner=BasePlannerConfig()), watch=watch)
    assert report.success and len(plans) > 5 and all(plans)
    assert report.plans > 2, "the way was seen piece by piece"
    assert report.failed_plans == 0, "it did not have to stop for that"


def test_what_can_never_be_seen_is_given_up() -> None:
    robot = Unicycle()
    _, report = drive(
        robot, Observed(FREE, torch.zeros(1, 2), 1.2), replace(QUICK, planner=BasePlannerConfig())
    )
    assert report.status is DriveStatus.UNREACHABLE and report.message
    assert np.abs(np.array(robot.states)[:, :2]).max() < 1.3, "it did not creep on"


def test_before_a_dead_end_it_turns_to_where_the_way_would_go_on() -> None:
    goal = np.array([-3.0, 0.0])  # behind it
    robot = Unicycle()
    config = replace(QUICK, planner=BasePlannerConfig(room=0.05))
    _, report = drive(robot, Observed(FREE, torch.zeros(1, 2), 0.04), config, goal=goal)
    assert report.status is DriveStatus.UNREACHABLE, "not before it had looked there"
    assert abs(math.remainder(robot.state[2] - math.pi, 2 * math.pi)) < 0.4
    assert robot.looked_at[-1][0] < robot.state[0]


def test_the_camera_nods() -> None:
    robot = Unicycle()
    drive(robot, FREE)
    heights = np.array(robot.looked_at)[:, 2]
    assert set(heights.tolist()) == {height for _, height in QUICK.gaze.looks}
    assert np.flatnonzero(np.diff(heights)).size > 4


def test_every_other_look_round_is_at_level() -> None:
    robot, gaze = Unicycle(), GazeConfig()
    for _ in range(8):
        Gaze(robot, gaze).towards(robot.base_state(), 0.0)
        robot.time += gaze.nod
    low = [(0.7, 0.0), (1.5, 1.1), (1.0, 0.0), (1.5, 1.1)]
    assert [(x, z) for x, _, z in robot.looked_at] == 2 * low


@pytest.mark.parametrize("values", [{"nod": 0.0}, {"looks": ()}, {"looks": ((-1.0, 0.0),)}, {"near": 0.0}])
def test_bad_ways_of_looking_are_refused(values: dict) -> None:
    with pytest.raises(Exception, match=next(iter(values))):
        GazeConfig(**values)


@pytest.mark.parametrize("values", [{"room": 0.0}, {"memory": -1.0}])
def test_bad_memories_are_refused(values: dict) -> None:
    with pytest.raises(Exception, match=next(iter(values))):
        BasePlannerConfig(**values)


@dataclass
class Visited(Observed):
    """Something has come where x is greater than a limit [m]."""

    limit: float = 0.0

    def came(self, points: Tensor) -> Tensor:
        return points[..., 0] > self.limit


FLOOR = Box((0.0, 0.0, -1.0), (30.0, 30.0, 1.0))
EVERYWHERE = (torch.zeros(1, 2), 99.0)


def test_what_came_counts_as_nearer() -> None:
    walls = Box((2.0, 0.0, 0.5), (0.3, 9.0, 1.0)), Box((-2.0, 0.0, 0.5), (0.3, 9.0, 1.0)), FLOOR
    field = Visited(Union(*walls), *EVERYWHERE, limit=1.0)
    assert isinstance(field, ChangingField)
    points = torch.tensor(
        [[-0.2, 0.0, 2.0], [0.2, 0.0, 2.0], [1.5, 0.0, 0.1]]
    )  # the last is nearest to the floor
    wary = ExploredField(field, trodden(), 0.08)
    for distance in (wary.distance(points), wary.distance_and_gradient(points)[0]):
        torch.testing.assert_close(distance, field.distance(points) - torch.tensor([0.0, 0.08, 0.0]))
    wary.distance(points.requires_grad_()).sum().backward()
    torch.testing.assert_close(points.grad, wary.distance_and_gradient(points)[1])
    assert torch.equal(wary.distance_and_gradient(points)[1], field.distance_and_gradient(points)[1])
    assert torch.equal(ExploredField(field, trodden()).distance(points), field.distance(points))


@dataclass
class Steep(Visited):
    """Gradients are three times too long, as inside of thin things in a map."""

    def distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        distance, gradient = super().distance_and_gradient(points)
        return distance, 3 * gradient


def test_the_nearest_surface_is_found_however_long_gradients_are() -> None:
    wall = Box((2.0, 0.0, 0.5), (0.2, 9.0, 9.0))
    explored = ExploredField(Steep(wall, *EVERYWHERE, limit=1.7), trodden())
    inside = torch.tensor([[1.9, 0.1, 0.5]])
    torch.testing.assert_close(explored.nearest_surface(inside), torch.tensor([[1.8, 0.1, 0.5]]))
    assert explored.by_what_came(inside).all(), "all of somebody counts as what came, not only his rim"


GAP = Union(Box((2.0, 5.3, 0.5), (0.15, 5.0, 1.0)), Box((2.0, -5.3, 0.5), (0.15, 5.0, 1.0)))
"""60 cm between two walls, for a base of 50 cm."""


WARY = BasePlannerConfig(wary=0.08)


def test_no_passing_close_to_what_came() -> None:
    goal = torch.tensor([4.0, 0.0])
    for limit, fits in ((99.0, True), (1.0, False)):
        assert (
            BasePlanner(BODY, WARY).plan(START, goal, Visited(GAP, *EVERYWHERE, limit)).reaches_goal == fits
        )
    planner = BasePlanner(BODY, WARY)
    through = planner.plan(START, goal, Visited(GAP, *EVERYWHERE, 99.0)).result
    assert planner.still_good(through, START, Visited(GAP, *EVERYWHERE, 99.0))
    assert not planner.still_good(through, START, Visited(GAP, *EVERYWHERE, 1.0))


def test_who_stands_too_close_to_what_came_drives_off_and_keeps_off_the_rest() -> None:
    start = torch.tensor([1.43, 0.0])  # 2 cm before what came
    pillar = Cylinder((0.3, 0.2), 0.3)
    field = Visited(Union(Box((2.0, 0.0, 0.5), (0.3, 30.0, 1.0)), pillar), *EVERYWHERE, limit=1.2)
    plan = BasePlanner(BODY, WARY).plan(start, torch.tensor([-1.5, 0.2]), field)
    assert plan.usable and plan.reaches_goal and "searched route" in plan.result.message
    path = Trajectory.through(plan.result.trajectory.waypoints, 200).waypoints
    assert float((path - torch.tensor([0.3, 0.2])).norm(dim=1).min()) - 0.55 > -0.005


def test_the_trail_grows_every_way_and_forgets_nothing() -> None:
    discs = [(0.0, 0.0, 0.2), (3.0, 0.1, 0.3), (-2.0, -1.0, 0.25), (0.4, 5.0, 0.2), (0.2, 0.2, 0.2)]
    explored = ExploredField(Observed(FREE, torch.full((1, 2), 99.0), 0.0), trodden(*discs))
    at = torch.tensor(np.random.default_rng(0).uniform(-4, 6, (20_000, 3)), dtype=torch.float32)
    gaps = torch.stack([(at[:, :2] - torch.tensor([x, y])).norm(dim=1) - r for x, y, r in discs]).amin(dim=0)
    known = explored.confidence(at) > 0
    assert known[gaps < -0.04].all() and not known[gaps > 0.04].any() and int(known.sum()) > 20
