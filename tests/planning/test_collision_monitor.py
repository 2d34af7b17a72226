"""The collision monitor: brakes in time for what the last images show, and for nothing else."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from planning import ConfigError
from planning.collision_monitor import CollisionMonitor, CollisionMonitorConfig, moved

CONFIG = CollisionMonitorConfig()
AT_ORIGIN = np.zeros(3)


@dataclass
class Image:
    """A depth image that is told its points."""

    cloud: np.ndarray
    time: float = 0.0
    sees_all: bool = True

    def points(self) -> np.ndarray:
        return self.cloud

    def sees(self, points: np.ndarray) -> np.ndarray:
        return np.full(len(points), self.sees_all)


@dataclass
class Robot:
    """A pillar of three spheres 0.3 m round, and a hand that sticks out in front."""

    state: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def body(self) -> tuple[np.ndarray, np.ndarray]:
        local = np.array([[0, 0, 0.3], [0, 0, 0.7], [0, 0, 1.1], [0.4, 0, 0.7]], dtype=float)
        c, s = math.cos(self.state[2]), math.sin(self.state[2])
        turned = local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        return turned + np.r_[self.state[:2], 0], np.array([0.3, 0.3, 0.3, 0.05])


def wall(x: float, y: tuple[float, float] = (-1.0, 1.0)) -> np.ndarray:
    """Points on a wall across the x axis, up to 1.4 m high."""
    grid = np.stack(np.meshgrid([x], np.arange(*y, 0.02), np.arange(0, 1.4, 0.02)), axis=-1)
    return grid.reshape(-1, 3)


def floor() -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(0, 3, 0.05), np.arange(-1, 1, 0.05), [0.01]), axis=-1)
    return grid.reshape(-1, 3)


def watching(*clouds: np.ndarray, robot: Robot | None = None, config: CollisionMonitorConfig = CONFIG):
    monitor = CollisionMonitor((robot or Robot()).body, config)
    monitor.see(Image(np.concatenate([floor(), *clouds])))
    return monitor


def test_an_open_way_is_left_alone() -> None:
    monitor = watching(wall(2.5))
    assert monitor.limit(AT_ORIGIN, 0.6, 0.4, 0.1) == (0.6, 0.4)
    assert monitor.interventions.slowed == monitor.interventions.stopped == 0 and not monitor.slowing


def test_a_wall_ahead_slows_and_then_stops() -> None:
    # The hand reaches 0.45 m ahead.
    speeds = [watching(wall(x)).limit(AT_ORIGIN, 0.6, 0.0, 0.1)[0] for x in (1.2, 0.75, 0.6, 0.48)]
    assert speeds[0] == 0.6 and speeds[-1] == 0.0
    assert all(a >= b for a, b in itertools.pairwise(speeds)) and 0 < speeds[2] < 0.6


@pytest.mark.parametrize("speed", [0.2, 0.4, 0.6])
def test_driving_at_a_wall_ends_before_it(speed: float) -> None:
    robot, period, v = Robot(), 0.1, 0.0
    monitor = CollisionMonitor(robot.body)
    for step in range(100):
        monitor.see(Image(np.concatenate([floor(), wall(2.0)]), step * period))
        wanted = monitor.limit(robot.state, speed, 0.0, step * period)[0]
        v = max(v - CONFIG.braking * period, wanted)  # brakes no faster than it can
        robot.state = robot.state + np.array([v * period, 0, 0])
    assert v == 0 and monitor.interventions.stopped > 0
    assert 0 < 2.0 - (robot.state[0] + 0.45) < 0.15


def test_it_keeps_commanding_the_same_arc() -> None:
    v, omega = watching(wall(0.6)).limit(AT_ORIGIN, 0.6, 0.3, 0.1)
    assert 0 < v < 0.6 and omega / v == pytest.approx(0.5)


def test_turning_the_hand_into_a_wall_is_stopped_and_away_from_it_is_not() -> None:
    robot = Robot(np.array([0.0, 0.0, 0.9]))  # the hand points half left
    beside = np.stack(np.meshgrid(np.arange(-1, 1, 0.02), [0.41], np.arange(0.1, 1.4, 0.02)), axis=-1)
    monitor = watching(beside.reshape(-1, 3), robot=robot)
    assert monitor.limit(robot.state, 0.0, 1.0, 0.1)[1] < 0.5
    assert monitor.limit(robot.state, 0.0, -1.0, 0.1) == (0.0, -1.0)


def test_too_near_already_it_may_leave_but_not_come_nearer() -> None:
    monitor = watching(wall(0.455))
    assert monitor.limit(AT_ORIGIN, 0.2, 0.0, 0.1) == (0.0, 0.0)
    assert monitor.limit(AT_ORIGIN, -0.2, 0.0, 0.1) == (-0.2, 0.0)


def test_it_does_not_creep_nearer_however_often_it_is_asked() -> None:
    robot = Robot()
    monitor = CollisionMonitor(robot.body)
    for step in range(300):
        monitor.see(Image(np.concatenate([floor(), wall(0.48)]), 0.1 * step))
        robot.state[0] += 0.1 * monitor.limit(robot.state, 0.3, 0.0, 0.1 * step)[0]
    assert robot.state[0] < 0.02


def test_a_stray_point_is_noise_and_the_floor_is_no_obstacle() -> None:
    stray = np.array([[0.6, 0.0, 0.7]])
    assert watching(stray).limit(AT_ORIGIN, 0.6, 0.0, 0.1)[0] == 0.6
    cloud = stray + np.random.default_rng(0).normal(0, 0.003, (CONFIG.agreeing, 3))
    assert watching(cloud).limit(AT_ORIGIN, 0.6, 0.0, 0.1)[0] < 0.6


@pytest.mark.parametrize("image", [None, Image(np.empty((0, 3)), 5.0), Image(np.full((500, 3), np.nan), 5.0)])
def test_without_a_new_image_it_stops_and_goes_on_with_one(image: Image | None) -> None:
    monitor = watching(wall(2.5))
    assert monitor.limit(AT_ORIGIN, 0.4, 0.0, CONFIG.max_age - 0.05) == (0.4, 0.0)
    monitor.see(image)
    assert monitor.limit(AT_ORIGIN, 0.4, 0.1, 5.0) == (0.0, 0.0)
    assert monitor.interventions.blind == 1 and "no depth image" in monitor.interventions.reason
    monitor.see(Image(floor(), 5.0))
    assert monitor.limit(AT_ORIGIN, 0.4, 0.0, 5.1) == (0.4, 0.0)


def looked_away(*clouds: np.ndarray, seen: float = 0.0, robot: Robot | None = None) -> CollisionMonitor:
    """It saw these, and a moment later the camera shows nothing but the floor elsewhere."""
    monitor = CollisionMonitor((robot or Robot()).body)
    monitor.see(Image(np.concatenate([floor(), *clouds]), seen))
    monitor.see(Image(floor(), seen + 0.5, sees_all=False))
    return monitor


def test_what_the_camera_has_turned_away_from_stops_it_for_a_while() -> None:
    monitor = looked_away(wall(0.46))
    assert monitor.limit(AT_ORIGIN, 0.3, 0.0, 0.6) == (0.0, 0.0)
    later = CONFIG.memory + 0.1
    monitor.see(Image(floor(), later, sees_all=False))
    assert monitor.limit(AT_ORIGIN, 0.3, 0.0, later) == (0.3, 0.0), "by then it may have gone"


def test_what_an_image_shows_to_have_gone_is_forgotten_at_once() -> None:
    monitor = looked_away(wall(0.46))
    monitor.see(Image(floor(), 0.6))
    assert monitor.limit(AT_ORIGIN, 0.3, 0.0, 0.6) == (0.3, 0.0)


def test_narrow_places_are_driven_through_with_their_sides_out_of_view() -> None:
    ahead = wall(0.31)[:, [1, 0, 2]]  # from 1 m behind to 1 m ahead, at y = 0.31
    sides = ahead[ahead[:, 0] > 0.2], (ahead * (1, -1, 1))[ahead[:, 0] > 0.2]
    assert watching(*sides).limit(AT_ORIGIN, 0.3, 0.0, 0.1)[0] < 0.3
    assert looked_away(*sides).limit(AT_ORIGIN, 0.3, 0.0, 0.6) == (0.3, 0.0)


def test_lone_points_are_not_remembered() -> None:
    assert looked_away(np.array([[0.5, 0.0, 0.7]])).limit(AT_ORIGIN, 0.3, 0.0, 0.6) == (0.3, 0.0)


def test_the_first_image_is_waited_for() -> None:
    assert CollisionMonitor(Robot().body).limit(AT_ORIGIN, 0.1, 0.0, 0.0) == (0.0, 0.0)


def test_standing_still_is_no_intervention() -> None:
    monitor = watching(wall(0.455))
    assert monitor.limit(AT_ORIGIN, 0.0, 0.0, 9.0) == (0.0, 0.0)
    assert monitor.interventions.blind == monitor.interventions.stopped == 0


def test_spheres_move_with_the_base() -> None:
    robot = Robot(np.array([1.0, -2.0, 0.7]))
    step = np.array([0.3, -0.1, 0.5])
    c, s = math.cos(0.7), math.sin(0.7)
    ahead = Robot(robot.state + np.array([c * 0.3 + s * 0.1, s * 0.3 - c * 0.1, 0.5]))
    np.testing.assert_allclose(
        moved(robot.body()[0], robot.state, step[None])[0], ahead.body()[0], atol=1e-12
    )


@pytest.mark.parametrize("values", [{"braking": 0.0}, {"margin": -0.1}, {"agreeing": 0}, {"max_age": 0.0}])
def test_bad_settings_are_refused(values: dict) -> None:
    with pytest.raises(ConfigError, match="CollisionMonitorConfig"):
        replace(CONFIG, **values)
