"""The robot lets pass what crosses its way, for a while, where the way round is long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from planning.drive import DriveStatus
from planning.errors import ConfigError
from planning.giving_way import GivingWay, length_left, path_length
from planning.position_costs import GridSearchConfig
from planning.replanning import ReplanningConfig
from tests.planning.fields import Box, Union
from tests.planning.test_replanning import FREE, GOAL, QUICK, drive, places
from tests.planning.unicycles import Unicycle

# A wall with a passage on the way and another one far aside.
WALL = Union(Box((1.5, 1.9, 0.5), (0.1, 1.4, 1.0)), Box((1.5, -5.5, 0.5), (0.1, 5.0, 1.0)))
PERSON = Box((1.5, 0.0, 0.5), (0.2, 0.5, 1.0))
LOOP = replace(QUICK, planner=replace(QUICK.planner, search=GridSearchConfig(padding=5.0)))


def crossed(config: ReplanningConfig, until: float):
    """A drive on which somebody stands in the passage for a while."""
    robot = Unicycle()

    def knows():
        there = robot.state[0] > 0.3 and robot.time < until
        return Union(WALL, PERSON) if there else WALL

    loop, report = drive(robot, knows, config, goal=GOAL)
    assert report.status is DriveStatus.REACHED, report.message
    return loop, report, robot


def test_who_crosses_the_way_is_let_pass() -> None:
    _, report, robot = crossed(replace(LOOP, wait=8.0), until=6.0)
    assert np.abs(places(robot)[:, 1]).max() < 0.6 and report.path_length < 3.5
    assert not report.failed_plans


def test_who_stays_is_driven_round_after_the_wait() -> None:
    waited, at_once = (crossed(replace(LOOP, wait=wait), until=60.0) for wait in (4.0, 0.01))
    for _, report, robot in (waited, at_once):
        assert places(robot)[:, 1].max() > 3.3 and report.path_length > 5.0
    assert 3.0 < waited[1].duration - at_once[1].duration < 7.0


def test_a_way_round_that_is_short_is_taken_at_once() -> None:
    _, report, robot = crossed(replace(LOOP, wait=60.0, detour=9.0), until=60.0)
    assert places(robot)[:, 1].max() > 3.3 and report.duration < 45.0


def test_the_wait_counts_from_its_begin_and_ends() -> None:
    loop, _ = drive(Unicycle(), lambda: FREE)
    plan, giving_way = loop.plan, GivingWay(patience=2.0, detour=1.0)
    assert plan is not None
    assert giving_way.waits(plan, 3.0, 4.5, now=10.0) and giving_way.plan is plan
    assert giving_way.waits(plan, 3.0, 4.5, now=11.9)
    assert not giving_way.waits(plan, 3.0, 4.5, now=12.1) and giving_way.plan is None
    assert giving_way.waits(plan, 3.0, 4.5, now=12.2), "another wait"
    assert not giving_way.waits(plan, 3.0, 3.9, now=12.3) and giving_way.plan is None


def test_lengths_of_ways() -> None:
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    assert path_length(path) == 3.0 and path_length(path[:1]) == 0.0
    assert length_left(path, np.array([0.9, 0.2])) == 2.0


@pytest.mark.parametrize("values", [{"detour": 0.0}, {"detour": -1.0}])
def test_detours_that_are_none_are_refused(values: dict) -> None:
    with pytest.raises(ConfigError, match=r"must be positive: .*detour"):
        ReplanningConfig(**values)
