"""The closed loop with an exact robot and a map that is told what to know."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from planning import ChompConfig, ConfigError
from planning.base_planner import BasePlannerConfig
from planning.clock import FixedClock, FootprintMap, OnlineMap
from planning.drive import DriveReport, DriveStatus, MobileRobot
from planning.position_costs import GridSearchConfig
from planning.replanning import ReplanningConfig, ReplanningLoop
from tests.planning.fields import Box, Cylinder, Sphere, Union, walls_round
from tests.planning.robots import Disc
from tests.planning.unicycles import TaughtMap, Unicycle

BODY = Disc(radius=0.25)
FREE = Sphere((0.0, 0.0, 50.0), 0.1)
PILLAR = Cylinder((1.5, 0.1), 0.3)
GOAL = np.array([3.0, 0.0])
QUICK = ReplanningConfig(
    planner=BasePlannerConfig(
        search=GridSearchConfig(padding=1.5),
        chomp=ChompConfig(eps=0.35, max_iterations=60),
        num_waypoints=20,
    ),
    scan=0.3,
    time_limit=60.0,
    patience=2,
    retry=0.3,
)
CLOCK = FixedClock(steps=2)


def drive(robot: Unicycle, knows, config=QUICK, clock=CLOCK, goal=GOAL, final_yaw=None, watch=None):
    """One drive; the loop and its report."""
    mapper = TaughtMap(knows)
    loop = ReplanningLoop(robot, BODY, mapper, mapper.snapshot, config, clock, watch)
    return loop, loop.drive_to(goal, final_yaw)


def places(robot: Unicycle) -> np.ndarray:
    return np.array(robot.states)[:, :2]


def test_the_stand_ins_satisfy_the_protocols() -> None:
    assert isinstance(Unicycle(), MobileRobot) and isinstance(TaughtMap(FREE), OnlineMap)


def test_reaches_the_goal_round_an_obstacle_and_never_touches_it() -> None:
    robot = Unicycle()
    _, report = drive(robot, PILLAR)
    assert report.status is DriveStatus.REACHED and report.success
    assert np.linalg.norm(robot.state[:2] - GOAL) < 0.05
    assert report.goal_distance == pytest.approx(np.linalg.norm(robot.state[:2] - GOAL))
    assert robot.clearance(BODY, PILLAR) > 0
    assert np.linalg.norm(np.diff(places(robot), axis=0), axis=1).sum() == pytest.approx(
        report.path_length, rel=0.01
    )
    assert 3.0 < report.path_length < 4.0
    assert report.plans == 1 and report.failed_plans == 0, "what has not changed needs no new plan"
    assert report.duration == pytest.approx(robot.time)
    assert robot.commands[-1] == (0.0, 0.0)


def test_an_obstacle_that_appears_on_the_path_is_avoided() -> None:
    world = Union(FREE, PILLAR)
    robot, learned = Unicycle(), []

    def knows():
        if robot.state[0] > 0.3 and not learned:
            learned.append(robot.time)
        return world if learned else FREE

    _, report = drive(robot, knows)
    assert learned and report.success
    assert report.plans >= 2
    assert robot.clearance(BODY, world) > 0
    blind = Unicycle()
    drive(blind, FREE)
    assert blind.clearance(BODY, world) < 0, "the obstacle lies on the first plan"


def test_an_obstacle_off_the_path_changes_nothing() -> None:
    robot = Unicycle()
    _, report = drive(robot, lambda: Cylinder((1.5, 2.0), 0.3) if robot.state[0] > 0.3 else FREE)
    assert report.success and report.plans == 1


def test_a_blocked_goal_is_unreachable_and_the_robot_stops() -> None:
    robot, field = Unicycle(), walls_round(3.0)
    _, report = drive(robot, field)
    assert report.status is DriveStatus.UNREACHABLE and not report.success
    assert report.message
    assert report.failed_plans == QUICK.patience + 1
    assert report.duration < QUICK.time_limit
    assert robot.commands[-1] == (0.0, 0.0)
    # It went as near as it could before giving up, and touched nothing.
    assert 0.8 < report.goal_distance < 1.2
    assert robot.clearance(BODY, field) > -0.01
    assert report.path_length < 3.0, "it did not circle the walls"


def test_a_way_that_opens_late_is_taken_to_the_goal() -> None:
    # Until the robot has stood before the wall for a while, the map shows no way on.
    wall, robot, waited = Box((1.5, 0.0, 0.5), (0.1, 6.0, 2.0)), Unicycle(), []

    def knows():
        if robot.state[0] > 0.9 and abs(robot.commands[-1][0]) < 1e-3:
            waited.append(robot.time)
        return FREE if len(waited) > 1 else wall

    _, report = drive(robot, knows, replace(QUICK, patience=20))
    assert waited
    assert report.status is DriveStatus.REACHED
    assert report.goal_distance < 0.05, "standing before the wall is not standing on the goal"


def test_a_drive_after_one_that_failed_starts_afresh() -> None:
    robot, mapper = Unicycle(), TaughtMap(walls_round(3.0))
    loop = ReplanningLoop(robot, BODY, mapper, mapper.snapshot, QUICK, CLOCK)
    first = loop.drive_to(GOAL)
    assert first.status is DriveStatus.UNREACHABLE
    again = loop.drive_to(GOAL)
    assert again.status is DriveStatus.UNREACHABLE and again.message
    assert again.failed_plans == QUICK.patience + 1
    home = loop.drive_to(np.zeros(2))
    assert home.success and home.goal_distance < 0.05 and home.failed_plans == 0


def test_the_time_limit_ends_a_drive() -> None:
    robot = Unicycle()
    _, report = drive(robot, FREE, replace(QUICK, time_limit=3.0), goal=np.array([4.0, 0.0]))
    assert report.status is DriveStatus.TIME_LIMIT and "3 s" in report.message
    assert 3.0 <= report.duration < 3.0 + 1.0
    assert 0.5 < report.goal_distance < 4.0
    assert robot.commands[-1] == (0.0, 0.0)


def test_bad_frames_are_counted_and_passed_over() -> None:
    count = itertools.count()
    robot = Unicycle(frame=lambda time: "bad" if next(count) % 3 == 1 else "frame")
    loop, report = drive(robot, PILLAR)
    assert report.success
    assert report.frames_refused > 3
    assert report.frames == loop.mapper.frames
    assert report.frames / report.frames_refused == pytest.approx(2.0, abs=0.5)


def test_no_new_frame_is_no_frame() -> None:
    robot = Unicycle(frame=lambda time: None if time > 0.5 else "frame")
    loop, report = drive(robot, PILLAR)
    assert report.success and report.frames == loop.mapper.frames < 5 and report.frames_refused == 0


def test_the_first_frames_all_bad() -> None:
    # The scan takes 0.6 s: when it ends, the map still knows nothing and has no field to plan in.
    robot = Unicycle(frame=lambda time: "bad" if time < 2.0 else "frame")
    _, report = drive(robot, PILLAR)
    assert report.success and report.frames_refused > 3
    assert robot.clearance(BODY, PILLAR) > 0


@pytest.mark.parametrize("frame", ["bad", None])
def test_without_any_frame_the_robot_stays_and_says_why(frame: str | None) -> None:
    robot = Unicycle(frame=lambda time: frame)
    _, report = drive(robot, FREE, replace(QUICK, time_limit=3.0))
    assert report.status is DriveStatus.TIME_LIMIT and "frame" in report.message
    assert report.plans == 0 and report.path_length == 0
    assert (places(robot) == 0).all()


def test_free_computing_does_not_stop_time() -> None:
    robot = Unicycle()
    _, report = drive(robot, PILLAR, clock=FixedClock(steps=1, training=0.0, planning=0.0))
    assert report.success
    assert report.mapping_seconds == 0 and report.duration > 5


@pytest.mark.parametrize(
    "clock", [FixedClock(steps=1), FixedClock(steps=1, training=0.33, planning=0.87)], ids=["quick", "slow"]
)
def test_the_world_moves_on_by_what_computing_costs(clock: FixedClock) -> None:
    robot = Unicycle()
    _, report = drive(robot, FREE, clock=clock)
    assert report.success
    # Less than a period is owed at the end; then one period at rest.
    charged = report.mapping_seconds + report.planning_seconds
    assert report.duration == pytest.approx(charged + 0.1, abs=0.11)
    assert report.slowest_plan == pytest.approx(clock.planning)


def test_slow_planning_costs_time() -> None:
    durations = []
    for planning in (0.1, 4.0):
        robot = Unicycle()
        _, report = drive(robot, PILLAR, clock=FixedClock(steps=1, planning=planning))
        assert report.success and robot.clearance(BODY, PILLAR) > 0
        durations.append(report.duration)
    # Before the first plan is there the robot can only wait.
    assert durations[1] > durations[0] + 3.0


def test_runs_at_fixed_cost_repeat_exactly() -> None:
    runs = []
    for _ in range(2):
        robot = Unicycle()
        _, report = drive(robot, lambda robot=robot: PILLAR if robot.state[0] > 0.3 else FREE)
        runs.append((np.array(robot.states), replace(report)))
    (first, one), (second, two) = runs
    np.testing.assert_array_equal(first, second)
    assert one == two


def test_ends_with_the_yaw_asked_for() -> None:
    for yaw in (2.0, -1.0):
        robot = Unicycle()
        _, report = drive(robot, FREE, goal=np.array([1.5, 0.5]), final_yaw=yaw)
        assert report.success
        assert abs((robot.state[2] - yaw + math.pi) % (2 * math.pi) - math.pi) < 0.05


def test_looks_round_first_and_then_where_it_goes() -> None:
    robot, seen = Unicycle(), []

    def watch(loop: ReplanningLoop) -> None:
        seen.append((loop.plan is not None, robot.state.copy(), robot.looked_at[-1]))

    config = replace(QUICK, scan=1.5, scan_rate=0.5)
    drive(robot, FREE, config, watch=watch)
    planned = next(i for i, (has_plan, _, _) in enumerate(seen) if has_plan)
    turned = seen[planned][1]
    assert turned[2] >= 1.5 and (turned[:2] == 0).all(), "turns on the spot before the first plan"
    for _, state, target in seen[planned + 2 :]:
        if np.linalg.norm(GOAL - state[:2]) > 1.7:
            toward = np.arctan2(*(target[:2] - state[:2])[::-1])
            assert abs(toward - np.arctan2(*(GOAL - state[:2])[::-1])) < 0.3
            assert 0.8 < np.linalg.norm(target[:2] - state[:2]) < 2.0


def test_a_map_that_can_be_told_is_told_where_the_robot_is() -> None:
    robot, told = Unicycle(), []

    class Told(TaughtMap):
        def clear_footprint(self, centres, radii):
            told.append((centres, radii))

    def fills():
        return np.array([[*robot.state[:2], 0.3]]), np.array([0.25])

    mapper = Told(lambda: FREE)
    assert isinstance(mapper, FootprintMap) and not isinstance(TaughtMap(lambda: FREE), FootprintMap)
    report = ReplanningLoop(robot, BODY, mapper, mapper.snapshot, QUICK, CLOCK, footprint=fills).drive_to(
        GOAL
    )
    assert report.success and len(told) == report.frames - 1  # before the first there is no map
    assert told[0][0][0, 0] == 0.0 and abs(told[-1][0][0, 0] - GOAL[0]) < 0.2


def test_an_empty_report_is_no_success() -> None:
    assert not DriveReport().success


@pytest.mark.parametrize(
    "values",
    [
        {"scan_rate": 0.0},
        {"retry": -1.0},
        {"wait": 0.0},
        {"detour": math.nan},
        {"stuck": 0.0},
        {"time_limit": 0.0},
    ],
)
def test_bad_settings_are_refused(values: dict) -> None:
    with pytest.raises(ConfigError, match="ReplanningConfig"):
        ReplanningConfig(**values)


@pytest.mark.parametrize(
    "values",
    [
        {"clearance_change": 0.0},
        {"off_path": 0.0},
        {"num_waypoints": 2},
        {"spacing": 0.0},
        {"margin": -0.2},
        {"looks": 0},
    ],
)
def test_bad_planner_settings_are_refused(values: dict) -> None:
    with pytest.raises(ConfigError, match="BasePlannerConfig"):
        BasePlannerConfig(**values)


def test_what_the_map_only_takes_for_blocked_is_explored_through_the_doorway() -> None:
    wall = Union(Box((1.5, -2.1, 0.5), (0.1, 3.0, 1.0)), Box((1.5, 5.1, 0.5), (0.1, 3.0, 1.0)))
    imagined = Union(wall, Box((3.5, -2.25, 0.5), (2.0, 2.75, 1.0)))
    robot, seen = Unicycle(), []

    def knows():
        if robot.state[0] > 1.6 and not seen:  # behind the wall it sees that nothing is there
            seen.append(robot.time)
        return wall if seen else imagined

    search = replace(QUICK.planner.search, through_blocked=30.0)
    config = replace(QUICK, planner=replace(QUICK.planner, search=search), time_limit=120.0)
    _, report = drive(robot, knows, config)
    assert seen and report.success
    assert robot.clearance(BODY, wall) > -0.01


def test_a_goal_that_is_changed_on_the_way_is_driven_to_instead() -> None:
    robot, there = Unicycle(), np.array([1.2, -1.4])

    def watch(loop: ReplanningLoop) -> None:
        if loop.plan is not None and robot.state[0] > 0.5 and loop.goal[0] == GOAL[0]:
            assert loop.leads_to_goal
            loop.change_goal(there)
            assert loop.plan is None and not loop.leads_to_goal

    _, report = drive(robot, PILLAR, watch=watch)
    assert report.success and np.linalg.norm(robot.state[:2] - there) < 0.05
    assert report.goal_distance < 0.05 and places(robot)[:, 0].max() < GOAL[0] - 1.0
    assert any("the goal is now 1.20, -1.40" in event for event in report.events)
    assert robot.clearance(BODY, PILLAR) > 0


def test_a_goal_changed_at_the_last_moment_is_not_taken_for_the_one_that_was_reached() -> None:
    robot, there, asked = Unicycle(), np.array([1.0, 0.8]), []

    def watch(loop: ReplanningLoop) -> None:
        if loop.tracker.finished and not asked:
            asked.append(loop.robot.time)
            loop.change_goal(there)

    _, report = drive(robot, FREE, watch=watch)
    assert asked and report.success and np.linalg.norm(robot.state[:2] - there) < 0.05


def test_a_goal_moved_into_an_obstacle_is_reported_and_not_driven_to() -> None:
    robot = Unicycle()

    def watch(loop: ReplanningLoop) -> None:
        if loop.plan is not None and loop.goal[0] == GOAL[0]:
            loop.change_goal(np.array([1.5, 0.1]))

    _, report = drive(robot, PILLAR, config=replace(QUICK, time_limit=20.0), watch=watch)
    assert not report.success and report.message
    assert robot.clearance(BODY, PILLAR) > 0
