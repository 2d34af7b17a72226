"""What goes wrong on a drive, injected: the robot stops safely, says why, and goes on when it can."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from planning.clock import FixedClock
from planning.collision_monitor import CollisionMonitor
from planning.drive import DriveReport, DriveStatus
from planning.replanning import ReplanningLoop
from tests.planning.fields import AutogradField, Cylinder, Sphere, Union
from tests.planning.test_replanning import BODY, GOAL, QUICK
from tests.planning.unicycles import TaughtMap, Unicycle

FREE = Sphere((0.0, 0.0, 50.0), 0.1)
PILLAR = Cylinder((1.5, 0.1), 0.3)
CLOCK = FixedClock(steps=1, training=0.1, planning=0.1)


@dataclass
class Image:
    """What a camera sees all around: the surface of a pillar, and the floor."""

    cloud: np.ndarray
    time: float

    def points(self) -> np.ndarray:
        return self.cloud

    def sees(self, points: np.ndarray) -> np.ndarray:
        return np.ones(len(points), dtype=bool)


def surface(pillar: Cylinder) -> np.ndarray:
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 120), np.arange(0.1, 1.4, 0.05))
    x, y = np.asarray(pillar.centre, dtype=float)[:2]
    return np.stack(
        [x + pillar.radius * np.cos(angle), y + pillar.radius * np.sin(angle), height], -1
    ).reshape(-1, 3)


FLOOR = np.stack(np.meshgrid(np.arange(-1, 5, 0.1), np.arange(-2, 2, 0.1), [0.0]), axis=-1).reshape(-1, 3)


class SeeingUnicycle(Unicycle):
    """Sees the points it is told, at all times but those of a fault."""

    def __init__(self, cloud: np.ndarray, fault=lambda time: "none") -> None:
        super().__init__()
        self.cloud, self.fault = np.concatenate([FLOOR, cloud]), fault

    def observe(self):
        kind = self.fault(self.time)
        if kind == "silent":
            return None
        return Image(self.cloud[:10] if kind == "invalid" else self.cloud, self.time)

    def body(self) -> tuple[np.ndarray, np.ndarray]:
        centres, radii = BODY.spheres(torch.as_tensor(self.state[:2], dtype=torch.float32))
        return centres.double().numpy(), radii.double().numpy()


class WaryMap(TaughtMap):
    """Refuses images with next to nothing in them, as a real map does."""

    def integrate(self, frame) -> None:
        super().integrate("bad" if len(frame.cloud) < 100 else "frame")


def drive(robot: SeeingUnicycle, knows, config=QUICK, goal=GOAL, watch=None) -> DriveReport:
    mapper = WaryMap(knows)
    monitor = CollisionMonitor(robot.body)
    return ReplanningLoop(
        robot, BODY, mapper, mapper.snapshot, config, CLOCK, watch, monitor=monitor
    ).drive_to(goal)


def speed_between(robot: Unicycle, begin: float, end: float) -> float:
    """Greatest commanded speed [m/s] in a stretch of time; a command lasts 0.1 s."""
    return max(abs(v) for v, _ in robot.commands[round(10 * begin) : round(10 * end)])


def test_what_the_map_does_not_know_stops_the_robot_before_contact() -> None:
    robot = SeeingUnicycle(surface(PILLAR))
    report = drive(robot, FREE, replace(QUICK, stuck=1.0))
    assert report.status is DriveStatus.UNREACHABLE and "monitor" in report.message
    assert report.stopped > 0 and any("imminent" in event for event in report.events)
    assert robot.clearance(BODY, PILLAR) > 0
    unguarded = Unicycle()
    mapper = TaughtMap(FREE)
    ReplanningLoop(unguarded, BODY, mapper, mapper.snapshot, QUICK, CLOCK).drive_to(GOAL)
    assert unguarded.clearance(BODY, PILLAR) < 0, "the pillar is in the way"


def test_when_the_map_learns_what_the_monitor_saw_the_robot_goes_on() -> None:
    robot = SeeingUnicycle(surface(PILLAR))
    world, held = Union(FREE, PILLAR), []

    def knows() -> AutogradField:
        if robot.state[0] > 0.3 and robot.commands[-1] == (0.0, 0.0):
            held.append(robot.time)
        return world if len(held) > 3 else FREE

    report = drive(robot, knows)
    assert held and report.success and report.stopped > 0
    assert robot.clearance(BODY, world) > 0


def test_a_good_map_needs_no_monitor() -> None:
    robot = SeeingUnicycle(surface(PILLAR))
    report = drive(robot, PILLAR)
    assert report.success and report.stopped == report.blind == 0 and report.slowed < 10
    assert robot.clearance(BODY, PILLAR) > 0


@pytest.mark.parametrize("kind", ["silent", "invalid"])
def test_a_sensor_that_fails_for_three_seconds_stops_the_robot_until_it_is_back(kind: str) -> None:
    robot = SeeingUnicycle(surface(PILLAR), lambda time: kind if 3.0 <= time < 6.0 else "none")
    report = drive(robot, PILLAR)
    assert report.success and report.blind > 10
    assert any("no depth image" in event for event in report.events)
    assert speed_between(robot, 2.0, 3.0) > 0.2, "it was driving"
    assert speed_between(robot, 4.0, 6.0) == 0, "it stands while it is blind"
    assert speed_between(robot, 6.2, 8.5) > 0.2, "it goes on"
    assert robot.clearance(BODY, PILLAR) > 0
    if kind == "invalid":
        assert report.frames_refused > 0


def test_a_sensor_that_stays_dead_ends_the_drive_with_the_reason() -> None:
    robot = SeeingUnicycle(surface(PILLAR), lambda time: "silent" if time >= 3.0 else "none")
    report = drive(robot, PILLAR, replace(QUICK, stuck=1.0))
    assert report.status is DriveStatus.UNREACHABLE and "no depth image" in report.message
    assert speed_between(robot, 4.0, robot.time) == 0


def test_pushed_off_its_path_it_plans_anew_and_arrives() -> None:
    robot, pushed = SeeingUnicycle(surface(PILLAR)), []

    def push(loop: ReplanningLoop) -> None:
        if loop.plan is not None and robot.time > 3.0 and not pushed:
            pushed.append(loop.report.plans)
            robot.state = robot.state + np.array([0.0, -0.5, 0.4])

    report = drive(robot, PILLAR, watch=push)
    assert pushed and report.success and report.plans > pushed[0]
    assert robot.clearance(BODY, PILLAR) > 0


class WeakUnicycle(SeeingUnicycle):
    """Its motors saturate at a speed well below what the controller believes."""

    def drive(self, v: float, omega: float, duration: float) -> None:
        super().drive(float(np.clip(v, -0.15, 0.15)), float(np.clip(omega, -0.3, 0.3)), duration)


def test_a_controller_that_saturates_only_takes_longer() -> None:
    weak, strong = WeakUnicycle(surface(PILLAR)), SeeingUnicycle(surface(PILLAR))
    slow, fast = drive(weak, PILLAR), drive(strong, PILLAR)
    assert slow.success and fast.success
    assert slow.duration > 1.5 * fast.duration
    assert weak.clearance(BODY, PILLAR) > 0


def test_a_planner_that_finds_nothing_leaves_the_robot_standing() -> None:
    shut_in = Union(*(Cylinder((0.45 * np.cos(a), 0.45 * np.sin(a)), 0.15) for a in np.arange(0, 6.3, 0.5)))
    robot = SeeingUnicycle(np.empty((0, 3)))
    report = drive(robot, shut_in)
    assert report.status is DriveStatus.UNREACHABLE and report.message
    assert report.path_length < 0.2 and robot.commands[-1] == (0.0, 0.0)


def test_a_goal_inside_an_obstacle_is_reported_and_nothing_is_touched() -> None:
    robot = SeeingUnicycle(surface(PILLAR))
    report = drive(robot, PILLAR, replace(QUICK, time_limit=120.0), goal=np.array([1.5, 0.1]))
    assert report.status is DriveStatus.UNREACHABLE and report.message
    assert robot.clearance(BODY, PILLAR) > -0.01


def test_events_are_bounded() -> None:
    report = DriveReport()
    for k in range(1000):
        report.note(float(k), "again")
    assert len(report.events) == 100 and report.events[0] == "0.0 s: again"
