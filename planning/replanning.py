"""The closed loop: sense, map, plan, follow, and plan again when the map changes what the plan is worth.

It knows a robot, a map and a world only by the Protocols of `planning.drive`, `planning.clock` and
`planning.protocols`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from planning.base_planner import BasePlanner, BasePlannerConfig
from planning.clock import Clock, MeasuredClock, OnlineMap
from planning.drive import DriveReport, DriveStatus, MobileRobot
from planning.errors import ConfigError
from planning.protocols import DistanceField, SphereRobot
from planning.result import PlanResult
from planning.tracking import BaseTracker, TrackerConfig

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReplanningConfig:
    """How the loop drives.

    Args:
        planner: how the base plans.
        tracker: the base controller.
        scan: angle [rad] turned on the spot at the start, to see what is around.
        scan_rate: speed of that turn [rad/s]; slow enough for the map to learn what comes into view.
        retry: after a failed plan the robot turns and maps for this long [s] before the next attempt.
        look_ahead: distance along the path [m] at which the camera looks.
        patience: plans in a row that may fail before the goal is called unreachable.
        time_limit: [s] of the robot's time.
    """

    planner: BasePlannerConfig = field(default_factory=BasePlannerConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    scan: float = 2 * math.pi
    scan_rate: float = 0.5
    retry: float = 1.0
    look_ahead: float = 1.5
    patience: int = 15
    time_limit: float = 180.0

    def __post_init__(self) -> None:
        if not min(self.scan_rate, self.retry, self.time_limit) > 0:
            raise ConfigError(
                f"ReplanningConfig: scan_rate, retry and time_limit must be positive, got {self.scan_rate:g} rad/s, "
                f"{self.retry:g} s and {self.time_limit:g} s."
            )


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
    ) -> None:
        self.robot, self.mapper, self.snapshot = robot, mapper, snapshot
        self.config, self.clock = config or ReplanningConfig(), clock or MeasuredClock()
        self.watch = watch
        self.planner = BasePlanner(body, self.config.planner, seed)
        self.tracker = BaseTracker(self.config.tracker)
        self.plan: PlanResult | None = None
        self.field: DistanceField | None = None
        self.report = DriveReport()
        self._owed = 0.0
        self._failures = 0
        self._retry_at = -math.inf
        self._to_goal = False
        self._mapped = False

    def drive_to(self, goal: Float[ndarray, "2"], final_yaw: float | None = None) -> DriveReport:
        """Look around, then map, plan and drive until the goal is reached or given up.

        Args:
            goal: x, y [m].
            final_yaw: heading to end with [rad]; any if None.
        """
        started, self.report, self.plan = self.robot.time, DriveReport(), None
        self._failures, self._retry_at, self._to_goal = 0, -math.inf, False
        self.planner.forget()
        self._scan()
        self.tracker.reset()
        while self.robot.time - started < self.config.time_limit:
            spent = self._sense_and_map()
            leads_to_goal = self.plan is not None and self._to_goal
            fresh, planning = self._plan_if_needed(goal)
            self._follow(spent + planning, final_yaw)
            self.plan = fresh
            self.report.rounds += 1
            if self.watch:
                self.watch(self)
            if leads_to_goal and self.tracker.finished:
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
        self.report.goal_distance = float(np.linalg.norm(self.robot.base_state()[:2] - goal))
        return self.report

    def _scan(self) -> None:
        """Turn on the spot and map what comes into view."""
        rate, started = self.config.scan_rate, self.robot.time
        while rate * (self.robot.time - started) < self.config.scan:
            spent = self._sense_and_map()
            self._ahead(self.robot.base_state())
            self._pass_time(spent, lambda _: (0.0, rate))
            if self.watch:
                self.watch(self)

    def _sense_and_map(self) -> float:
        """Give the newest frame to the map and train; returns the time it took."""

        def integrate() -> None:
            frame = self.robot.observe()
            if frame is None:
                return
            try:
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
        if self.plan is None and self.robot.time < self._retry_at:
            return None, 0.0
        if self.report.frames == 0:
            self.report.message = "the map has had no frame yet"
            return None, 0.0
        plans = self.report.plans
        plan, spent = self.clock.charge(lambda: self._decide(goal))
        self.report.planning_seconds += spent
        if self.report.plans > plans:
            self.report.slowest_plan = max(self.report.slowest_plan, spent)
        return plan, spent

    def _decide(self, goal: Float[ndarray, "2"]) -> PlanResult | None:
        """Keep the plan while it is good; else make one, to the goal or as near to it as the map allows."""
        self.field = self.snapshot()
        start = torch.as_tensor(self.robot.base_state()[:2], dtype=torch.float32)
        end = torch.as_tensor(goal, dtype=torch.float32)
        if self.plan is not None and self.planner.still_good(self.plan, start, self.field):
            if self._to_goal:
                return self.plan
            if not self.tracker.finished and not self.planner.route(start, end, self.field).reaches_goal:
                return self.plan
        fresh = self.planner.plan(start, end, self.field)
        self.report.plans += 1
        if fresh.usable:
            self._failures, self._to_goal, self.report.message = 0, fresh.reaches_goal, ""
            return fresh.result
        self._failures += 1
        self._retry_at = self.robot.time + self.config.retry
        self.report.failed_plans += 1
        self.report.message = fresh.reason
        logger.info("no plan: %s", fresh.reason)
        return None

    def _follow(self, duration: float, final_yaw: float | None) -> None:
        """Let time pass on the plan; without one, turn on the spot to see more."""
        if self.plan is None:
            self._ahead(self.robot.base_state())
            self._pass_time(duration, lambda _: (0.0, self.config.scan_rate))
            return
        path = self.plan.trajectory.waypoints.numpy().astype(float)

        def command(state: ndarray) -> tuple[float, float]:
            self._look_along(path, state)
            return self.tracker.command(state, path, None, final_yaw)

        self._pass_time(duration, command)

    def _pass_time(self, duration: float, command: Callable[[ndarray], tuple[float, float]]) -> None:
        """Drive for `duration` [s] in whole control periods; what is left over is owed to the next round."""
        period = self.config.tracker.period
        self._owed += duration
        for _ in range(max(1, int(self._owed / period))):
            before = self.robot.base_state()
            self.robot.drive(*command(before), period)
            self.report.path_length += float(np.linalg.norm(self.robot.base_state()[:2] - before[:2]))
            self._owed -= period
        self._owed = max(0.0, self._owed)

    def _look_along(self, path: Float[ndarray, "n 2"], state: ndarray) -> None:
        """Look at the floor where the path will lead, or ahead where it ends."""
        nearest = int(np.linalg.norm(path - state[:2], axis=1).argmin())
        along = np.r_[0.0, np.linalg.norm(np.diff(path[nearest:], axis=0), axis=1).cumsum()]
        if along[-1] < 0.5:
            self._ahead(state)
            return
        target = path[nearest + int(np.searchsorted(along, self.config.look_ahead).clip(0, len(along) - 1))]
        self.robot.look_at(np.array([*target, 0.3]))

    def _ahead(self, state: ndarray) -> None:
        direction = np.array([math.cos(state[2]), math.sin(state[2])])
        self.robot.look_at(np.array([*(state[:2] + self.config.look_ahead * direction), 0.3]))

    def _end(self, status: DriveStatus, message: str) -> None:
        self.report.status, self.report.message = status, message
        logger.info("drive ended: %s (%s)", status.value, message)
