"""The closed loop: sense, map, plan, follow, and plan again when the map changes what the plan is worth.

It knows a robot, a map and a world only by the Protocols of `planning.drive`, `planning.clock` and
`planning.protocols`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from planning.base_planner import BasePlanner, BasePlannerConfig
from planning.bystanders import bystanders
from planning.clock import Clock, FootprintMap, MeasuredClock, OnlineMap
from planning.collision_monitor import CollisionMonitor, Spheres
from planning.drive import DriveReport, DriveStatus, MobileRobot
from planning.errors import ConfigError
from planning.gaze import Gaze, GazeConfig
from planning.giving_way import GivingWay, length_left, path_length
from planning.grid_search import Route
from planning.numbers import refuse_nan
from planning.protocols import DistanceField, SphereRobot
from planning.result import PlanResult
from planning.tracking import BaseTracker, TrackerConfig

logger = logging.getLogger(__name__)

# The base has made progress since a failure when it is this far from where it stood then [m].
PROGRESS = 0.1


@dataclass(frozen=True)
class ReplanningConfig:
    """How the loop drives.

    Args:
        planner: how the base plans.
        tracker: the base controller.
        scan: angle [rad] turned on the spot at the start, to see what is around.
        scan_rate: speed of that turn [rad/s]; slow enough for the map to learn what comes into view.
        retry: after a failed plan the robot turns and maps for this long [s] before the next attempt.
        wait: the same [s] where something came into the way, at most: it goes on as soon as that has gone.
        detour: where the way round what came is longer by more than this [m], the robot first stands and lets it pass,
            for `wait` at most.
        gaze: where the camera looks.
        extend: a plan that ends before unknown space is made anew when this much [m] less of the way is unknown.
        stuck: the plan is given up when the collision monitor has held the base for this long [s].
        patience: plans that may fail, or not be followed, without progress before the goal is called unreachable.
        time_limit: [s] of the robot's time.
    """

    planner: BasePlannerConfig = field(default_factory=BasePlannerConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    scan: float = 2 * math.pi
    scan_rate: float = 0.5
    retry: float = 1.0
    wait: float = 2.0
    detour: float = 0.5
    gaze: GazeConfig = field(default_factory=GazeConfig)
    extend: float = 0.5
    stuck: float = 2.0
    patience: int = 15
    time_limit: float = 180.0

    def __post_init__(self) -> None:
        refuse_nan(self)
        positive = ("scan_rate", "retry", "wait", "detour", "extend", "stuck", "time_limit")
        values = [getattr(self, name) for name in positive]
        if not all(value > 0 for value in values):
            got = ", ".join(f"{name} {value:g}" for name, value in zip(positive, values, strict=True))
            raise ConfigError(f"ReplanningConfig: these must be positive: {got}.")


class ReplanningLoop:
    """Drives a differential base through a world that is mapped on the way.

    While the computer maps and plans, the robot goes on with its last plan for as long as that takes.

    Args:
        robot: senses and drives.
        body: the spheres to keep clear, with q = (x, y); it must be clear at every heading, since the base turns on
            the spot.
        mapper: learns from the frames.
        snapshot: gives the field to plan in; called once a round, and charged to planning.
        config: see `ReplanningConfig`.
        clock: what computing costs.
        watch: called with the loop after every round, for pictures.
        seed: of the path search.
        monitor: has the last word on every command of the base; it sees an image each control period.
        footprint: gives the spheres that the robot fills now, centres (s, 3) and radii (s,) [m], for maps that can be
            told of them: no camera sees where its own robot is.
    """

    def __init__(
        self,
        robot: MobileRobot,
        body: SphereRobot,
        mapper: OnlineMap,
        snapshot: Callable[[], DistanceField],
        config: ReplanningConfig | None = None,
        clock: Clock | None = None,
        watch: Callable[[ReplanningLoop], None] | None = None,
        seed: int = 0,
        monitor: CollisionMonitor | None = None,
        footprint: Callable[[], Spheres] | None = None,
    ) -> None:
        self.robot, self.mapper, self.snapshot = robot, mapper, snapshot
        self.config, self.clock = config or ReplanningConfig(), clock or MeasuredClock()
        self.watch, self.monitor, self.footprint = watch, monitor, footprint
        self.planner = BasePlanner(body, self.config.planner, seed)
        self.tracker = BaseTracker(self.config.tracker)
        self.gaze = Gaze(robot, self.config.gaze)
        self.giving_way = GivingWay(self.config.wait, self.config.detour)
        self.plan: PlanResult | None = None
        self.field: DistanceField | None = None
        self.report = DriveReport()
        self.goal: ndarray = np.full(2, math.nan)
        self.last_planning = 0.0
        self._frame: Any = None
        self._owed = self._held = self._started = 0.0
        self._failures, self._failed_at = 0, np.full(2, math.inf)
        self._retry_at, self._came = -math.inf, False
        self._to_goal = False
        self._onward = np.empty((0, 2))
        self._mapped = False

    def drive_to(self, goal: Float[ndarray, "2"], final_yaw: float | None = None) -> DriveReport:
        """Look around, then map, plan and drive until the goal is reached or given up.

        Args:
            goal: x, y [m].
            final_yaw: heading to end with [rad]; any if None.
        """
        started = self._started = self.robot.time
        self.report = DriveReport()
        self._head_for(goal)
        self._scan()
        self.tracker.reset()
        while self.robot.time - started < self.config.time_limit:
            goal, spent = self.goal, self._sense_and_map()
            leads_to_goal = self.leads_to_goal
            fresh, planning = self._plan_if_needed(goal)
            leads_to_goal &= self.plan is not None  # else it was given up, and is not followed
            self._follow(spent + planning, final_yaw)
            self.plan = None if self._stuck() else fresh
            self.report.rounds += 1
            if self.watch:
                self.watch(self)
            if leads_to_goal and self.tracker.finished and goal is self.goal:
                self._end(DriveStatus.REACHED, "the base stands on the goal")
                break
            if self._failures > self.config.patience:
                self._end(DriveStatus.UNREACHABLE, self.report.message)
                break
        else:
            reason = f"; {self.report.message}" if self.report.message else ""
            self._end(DriveStatus.TIME_LIMIT, f"not there after {self.config.time_limit:g} s{reason}")
        self.robot.drive(0.0, 0.0, self.config.tracker.period)
        self.report.duration = self.robot.time - started
        self.report.goal_distance = float(np.linalg.norm(self.robot.base_state()[:2] - self.goal))
        return self.report

    def change_goal(self, goal: Float[ndarray, "2"]) -> None:
        """Drive to another goal x, y [m] from the next round on; for `watch` to call while a drive goes on."""
        self._head_for(goal)
        self.report.note(self.robot.time - self._started, f"the goal is now {goal[0]:.2f}, {goal[1]:.2f}")

    def _head_for(self, goal: Float[ndarray, "2"]) -> None:
        """Begin anew."""
        self.goal, self.plan, self._to_goal = np.array(goal, dtype=float), None, False
        self._failures, self._retry_at, self._held, self._onward = 0, -math.inf, 0.0, self._onward[:0]
        self.giving_way.end()
        self.planner.forget()

    @property
    def leads_to_goal(self) -> bool:
        """Whether there is a plan and it ends at the goal, not only nearer to it."""
        return self.plan is not None and self._to_goal

    @property
    def _pause(self) -> float:
        return self.config.wait if self._came else self.config.retry

    def _scan(self) -> None:
        """Turn on the spot and map what comes into view."""
        rate, started = self.config.scan_rate, self.robot.time
        while rate * (self.robot.time - started) < self.config.scan:
            spent = self._sense_and_map()
            state = self.robot.base_state()
            self.gaze.towards(state, float(state[2]))
            self._pass_time(spent, lambda _: (0.0, rate))
            if self.watch:
                self.watch(self)

    def _sense_and_map(self) -> float:
        """Give the newest frame to the map and train; returns the time it took."""
        frame, self._frame = self._frame or self.robot.observe(), None

        def integrate() -> None:
            if frame is None:
                return
            try:
                # Before the frame, so that one refresh of the map serves both.
                if self._mapped and self.footprint and isinstance(self.mapper, FootprintMap):
                    self.mapper.clear_footprint(*self.footprint())
                self.mapper.integrate(frame)
                self.report.frames += 1
                self._mapped = True
            except ValueError as error:
                logger.warning("frame passed over: %s", error)
                self.report.frames_refused += 1

        _, spent = self.clock.charge(integrate)
        if self._mapped:
            spent += self.clock.train(self.mapper)
        self.report.mapping_seconds += spent
        return spent

    def _plan_if_needed(self, goal: Float[ndarray, "2"]) -> tuple[PlanResult | None, float]:
        """The plan to follow from now on (None: stand), and the time it took to find out."""
        pausing = self.plan is None and self.robot.time < self._retry_at
        if pausing and not self._came:
            return None, 0.0
        if self.report.frames == 0:
            self.report.message = "the map has had no frame yet"
            return None, 0.0
        plans = self.report.plans
        plan, spent = self.clock.charge(lambda: self._decide(goal, pausing))
        self.report.planning_seconds += spent
        if self.report.plans > plans:
            self.last_planning = spent
            self.report.slowest_plan = max(self.report.slowest_plan, spent)
        return plan, spent

    def _decide(self, goal: Float[ndarray, "2"], pausing: bool) -> PlanResult | None:
        """Keep the plan while it is good; else make one, to the goal or as near to it as the map allows.

        In a pause there is only one if what came into the way has gone or walked on.
        """
        self.field = self.snapshot()
        self.gaze.bystanders = bystanders(self.field, self.robot.base_state()[:2])
        start = torch.as_tensor(self.robot.base_state()[:2], dtype=torch.float32)
        end = torch.as_tensor(goal, dtype=torch.float32)
        route = self.planner.route(start, end, self.field, self.robot.time) if pausing else None
        if route is not None and not self.planner.leads_on(route, self.field, self.robot.time):
            return None
        plan = self.plan or self.giving_way.plan
        if plan is not None:
            good = self.planner.still_good(plan, start, self.field)
            if good and self._to_goal:
                return plan
            route = route or self.planner.route(start, end, self.field, self.robot.time)
            if good and not self.tracker.finished and not self._leads_on(route):
                return plan
            if not good and self._lets_pass(plan, route):
                return None
        self.giving_way.end()
        fresh = self.planner.plan(start, end, self.field, route, self.robot.time)
        self.report.plans += 1
        self._onward = fresh.onward.numpy().astype(float)
        if fresh.came and not len(self._onward):
            self._onward = goal[None]
        if not fresh.usable and fresh.blocker is not None:
            self._onward = fresh.blocker.numpy().astype(float)[None]
        if fresh.usable:
            # A plan that the base cannot begin to follow is as good as none.
            gone = float(np.linalg.norm(self.robot.base_state()[:2] - self._failed_at))
            self._failures = 0 if gone > PROGRESS else self._failures
            self._to_goal, self.report.message = fresh.reaches_goal, ""
            return fresh.result
        self._give_up_plan(fresh.reason, fresh.came, walks=fresh.blocker is not None)
        return None

    def _lets_pass(self, plan: PlanResult, route: Route) -> bool:
        """Whether to wait for a plan that is blocked rather than take another route."""
        here, path = self.robot.base_state()[:2], plan.trajectory.waypoints.numpy().astype(float)
        left = length_left(path, here) + path_length(self._onward)
        way_round = path_length(route.path.numpy()) + path_length(route.onward.numpy())
        return self.giving_way.waits(plan, left, way_round, self.robot.time)

    def _leads_on(self, route: Route) -> bool:
        """Whether a route leaves less of the way unknown than the plan that is followed, which ends before the goal."""
        left = path_length(self._onward) - path_length(route.onward.numpy())
        return route.reaches_goal or left > self.config.extend

    def _follow(self, duration: float, final_yaw: float | None) -> None:
        """Let time pass on the plan; without one, turn on the spot to see more."""
        plan = self.plan or self.giving_way.plan
        if plan is None:
            turn, faces = self.gaze.onward(self._onward, self.robot.base_state(), self.config.scan_rate)
            if not faces:  # the next attempt waits until the camera has looked that way
                self._retry_at = max(self._retry_at, self.robot.time + duration + self._pause)
            self._pass_time(duration, lambda _: (0.0, turn))
            return
        path = plan.trajectory.waypoints.numpy().astype(float)

        def command(state: ndarray) -> tuple[float, float]:
            self.gaze.along(path, state)
            return self.tracker.command(state, path, None, final_yaw) if self.plan else (0.0, 0.0)

        self._pass_time(duration, command)

    def _pass_time(self, duration: float, command: Callable[[ndarray], tuple[float, float]]) -> None:
        """Drive for `duration` [s] in whole control periods; what is left over is owed to the next round."""
        period = self.config.tracker.period
        self._owed += duration
        for _ in range(max(1, int(self._owed / period))):
            before = self.robot.base_state()
            self.planner.stood(torch.as_tensor(before[:2], dtype=torch.float32))
            self.robot.drive(*self._monitored(before, *command(before)), period)
            self.report.path_length += float(np.linalg.norm(self.robot.base_state()[:2] - before[:2]))
            self._owed -= period
        self._owed = max(0.0, self._owed)

    def _monitored(self, state: ndarray, v: float, omega: float) -> tuple[float, float]:
        """The command that the collision monitor lets pass."""
        if self.monitor is None:
            return v, omega
        self._frame = self.robot.observe()
        self.monitor.see(self._frame)
        seen, before = self.monitor.interventions, self.monitor.slowing
        sent = self.monitor.limit(state, v, omega, self.robot.time)
        if self.monitor.slowing and not before:
            self.report.note(self.robot.time - self._started, seen.reason)
        if sent != (v, omega):
            self.tracker.overruled(*sent)
        held = (v, omega) != (0.0, 0.0) and sent == (0.0, 0.0)
        self._held = self._held + self.config.tracker.period if held else 0.0
        self.report.slowed, self.report.stopped, self.report.blind = seen.slowed, seen.stopped, seen.blind
        return sent

    def _stuck(self) -> bool:
        """Whether the plan was given up because the collision monitor does not let the base follow it."""
        if self.monitor is None or self._held < self.config.stuck:
            return False
        self._give_up_plan(f"the collision monitor held the base: {self.monitor.interventions.reason}")
        return True

    def _give_up_plan(self, reason: str, came: bool = False, walks: bool = False) -> None:
        """Stand without a plan until it is time for the next attempt.

        What came lately into the way and has not come to stay is no reason to call the goal unreachable.
        """
        self.plan, self._held = None, 0.0
        self.giving_way.end()
        self._failures += not walks
        self._failed_at = self.robot.base_state()[:2]
        self._came = came
        self._retry_at = self.robot.time + self._pause
        self.report.failed_plans += 1
        self.report.message = reason
        self.report.note(self.robot.time - self._started, reason)
        logger.info("no plan: %s", reason)

    def _end(self, status: DriveStatus, message: str) -> None:
        self.report.status, self.report.message = status, message
        logger.info("drive ended: %s (%s)", status.value, message)
