"""Where the camera looks between its other looks: at those who came lately and stand about."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from planning.bystanders import REACH, bystanders
from planning.gaze import Gaze, GazeConfig
from planning.position_costs import GridSearchConfig
from planning.protocols import ChangingField
from tests.planning.fields import AutogradField, Cylinder, Union
from tests.planning.test_replanning import FREE, QUICK, drive
from tests.planning.unicycles import Unicycle

HERE = np.array([0.3, -0.2])
VIEW = math.radians(29)


@dataclass
class Crowd(AutogradField):
    """People of 20 cm radius who came lately, and a pillar that did not."""

    people: list[tuple[float, float]]
    pillar: tuple[float, float] = (0.3, 0.6)

    def distance(self, points: Tensor) -> Tensor:
        return Union(FREE, Cylinder(self.pillar, 0.2), *(Cylinder(p, 0.2) for p in self.people)).distance(
            points
        )

    def came(self, points: Tensor) -> Tensor:
        if not self.people:
            return torch.zeros(points.shape[:-1], dtype=torch.bool)
        return torch.cdist(points[..., :2], torch.tensor(self.people).to(points)).amin(dim=-1) < 0.35


def test_those_who_came_are_found_nearest_first_and_once_each() -> None:
    people = [(1.5, -0.2), (-1.1, -0.2), (4.0, 0.0)]
    field = Crowd(people)
    assert isinstance(field, ChangingField)
    found = bystanders(field, HERE)
    assert len(found) == 2, "neither the pillar nor who is far off"
    for place, person in zip(found, people[:2], strict=True):
        assert np.linalg.norm(place - person) < 0.31
        off = math.atan2(*(place - HERE)[::-1]) - math.atan2(*(np.array(person) - HERE)[::-1])
        assert abs(math.remainder(off, 2 * math.pi)) < VIEW
    assert np.linalg.norm(found - HERE, axis=1).max() < REACH


def test_without_people_and_without_a_field_that_knows_there_are_none() -> None:
    assert bystanders(Crowd([]), HERE).shape == bystanders(FREE, HERE).shape == (0, 2)


def test_the_camera_looks_at_each_of_them_in_turn_and_along_the_path() -> None:
    robot, path = Unicycle(), np.array([[0.0, 0.0], [3.0, 0.0]])
    gaze = Gaze(robot, GazeConfig())
    gaze.bystanders = np.array([[0.5, 1.0], [0.5, -1.0], [-1.0, 0.1]])
    for _ in range(80):
        gaze.along(path, robot.state)
        robot.time += 0.1
    looks = [tuple(look[:2].round(6)) for look in robot.looked_at]
    assert {(0.5, 1.0), (0.5, -1.0)} < set(looks), "both who are beside"
    assert (-1.0, 0.1) not in looks, "not who is behind: the neck does not turn so far"
    assert sum(y == 0.0 for _, y in looks) > len(looks) / 2, "mostly where it drives"


def test_a_drive_keeps_an_eye_on_who_stands_beside_the_way() -> None:
    robot = Unicycle()
    _, report = drive(robot, Crowd([(1.0, -1.2)], (9.0, 9.0)))
    assert report.success
    glances = [look for look in robot.looked_at if np.linalg.norm(look[:2] - (1.0, -1.2)) < 0.35]
    assert 0.05 < len(glances) / len(robot.looked_at) < 0.4


def test_what_blocks_the_way_right_before_the_robot_is_faced_and_not_turned_away_from() -> None:
    robot = Unicycle((0.0, 0.0, 0.2))
    gaze = Gaze(robot, GazeConfig())
    close = np.array([[0.3, 0.0], [0.5, 0.0]])
    turn, faces = gaze.onward(close, robot.state, 0.5)
    assert turn < 0 and faces and abs(robot.looked_at[-1][1]) < 1e-6
    beyond = np.array([[0.3, 0.0], [0.0, 2.0]])
    turn, faces = gaze.onward(beyond, robot.state, 0.5)
    assert turn == 0.5 and not faces, "to the first that is farther"
    assert gaze.onward(close[:0], robot.state, 0.5) == (0.5, True), "all around, where there is no way on"


def test_while_it_waits_it_looks_at_what_came_even_where_no_way_is_left_to_try() -> None:
    robot = Unicycle()
    barrier = Crowd([(1.6, y / 4) for y in range(-24, 25)], (9.0, 9.0))
    search = GridSearchConfig(padding=1.5, through_blocked=30.0, closed_radius=30.0)
    # Some seconds later it goes back to make room.
    config = replace(
        QUICK, planner=replace(QUICK.planner, search=search, looks_came=1), time_limit=18.0, patience=15
    )
    drive(robot, lambda: FREE if robot.time < 3.0 else barrier, config)
    late = [look for look in robot.looked_at if look[2] < 1.1][-20:]
    assert abs(math.remainder(robot.state[2], 2 * math.pi)) < 0.5
    assert all(look[0] > robot.state[0] for look in late)


def test_somebody_right_before_the_camera_is_not_looked_at_from_above() -> None:
    robot = Unicycle((0.5, 0.0, 0.2))
    gaze = Gaze(robot, GazeConfig(nod=0.1))
    gaze.bystanders = np.array([[0.5, 0.4]])
    for _ in range(20):
        gaze.towards(robot.state, 0.2)
        robot.time += 0.1
    glances = [look for look in robot.looked_at if abs(look[0] - 0.5) < 1e-6]
    assert len(glances) >= 4
    assert all(look[1] >= 1.0 - 1e-6 and look[2] == 1.0 for look in glances), "the same way, but farther"
