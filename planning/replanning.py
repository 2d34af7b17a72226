"""The closed loop: sense, map, plan, follow, and plan again when the map changes what the plan is worth.

It knows a robot, a map and a world only by the Protocols here and in `planning.protocols`.
"""

from __future__ import annotations

import enum
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from planning.chomp import Chomp, ChompConfig
from planning.clock import Clock, MeasuredClock, OnlineMap
from planning.errors import ConfigError
from planning.grid_search import GridSearchConfig, Route, grid_search
from planning.protocols import DistanceField, SphereRobot
from planning.result import PlanResult
from planning.tracking import BaseTracker, TrackerConfig
from planning.trajectory import Trajectory
from planning.validation import check

logger = logging.getLogger(__name__)


@runtime_checkable
class MobileRobot(Protocol):
    """The robot and its world, real or simulated: it senses, drives, and lets time pass."""

    @property
    def time(self) -> float:
        """Now [s]."""
        ...

    def base_state(self) -> Float[ndarray, "3"]:
        """x, y [m] and yaw [rad] of the base."""
        ...

    def observe(self) -> Any | None:
        """The newest depth frame, without the robot's own body; None if there is no new one."""
        ...

    def look_at(self, point: Float[ndarray, "3"]) -> None:
        """Turn the camera towards a world point [m] as far as it goes."""
        ...

    def drive(self, v: float, omega: float, duration: float) -> None:
        """Drive at v [m/s] and omega [rad/s] for some time [s]."""
        ...


@dataclass(frozen=True)
class ReplanningConfig:
    """How the loop drives.

    Args:
        search: finds the route that CHOMP starts from.
        chomp: the optimiser; its margin is set by the loop.
        tracker: the base controller.
        num_waypoints: of a plan.
        margin: clearance [m] that plans keep where the map has a route with as much.
        clearance_change: a plan is made anew when the map has taken this much [m] of its clearance.
        scan: angle [rad] turned on the spot at the start, to see what is around.
        scan_rate: speed of that turn [rad/s]; slow enough for the map to learn what comes into view.
        retry: after a failed plan the robot turns and maps for this long [s] before the next attempt.
        looks: how often the robot stands before blocked space and looks, before it counts as blocked for good.
        look_ahead: distance along the path [m] at which the camera looks.
        patience: plans in a row that may fail before the goal is called unreachable.
        time_limit: [s] of the robot's time.
    """

    # A map still being learned is some centimetres wrong, and the robot stands where it stands: hence the negative
    # least margin.
    search: GridSearchConfig = field(
        default_factory=lambda: GridSearchConfig(least_margin=-0.05, through_blocked=30.0)
    )
    chomp: ChompConfig = field(default_factory=lambda: ChompConfig(eps=0.35, max_iterations=120))
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    num_waypoints: int = 40
    margin: float = 0.05
    clearance_change: float = 0.05
    scan: float = 2 * math.pi
    scan_rate: float = 0.5
    retry: float = 1.0
    looks: int = 3
    look_ahead: float = 1.5
    patience: int = 15
    time_limit: float = 180.0

    def __post_init__(self) -> None:
        positive = (self.clearance_change, self.scan_rate, self.retry, self.time_limit)
        if min(positive) <= 0 or self.num_waypoints < 3 or self.margin < self.search.least_margin:
            raise ConfigError(
                "ReplanningConfig: clearance_change, scan_rate, retry and time_limit must be positive, num_waypoints "
                f"at least 3 and margin at least search.least_margin, got {self}."
            )


class DriveStatus(enum.Enum):
    """How a drive ended."""

    REACHED = "reached"
    UNREACHABLE = "unreachable"
    TIME_LIMIT = "time limit"


@dataclass
class DriveReport:
    """What happened on a drive. Times in seconds, lengths in metres."""

    status: DriveStatus = DriveStatus.TIME_LIMIT
    message: str = ""
    duration: float = 0.0
    path_length: float = 0.0
    goal_distance: float = math.inf
    rounds: int = 0
    plans: int = 0
    failed_plans: int = 0
    frames: int = 0
    frames_refused: int = 0
    mapping_seconds: float = 0.0
    planning_seconds: float = 0.0
    slowest_plan: float = 0.0

    @property
    def success(self) -> bool:
        """True if the goal was reached."""
        return self.status is DriveStatus.REACHED


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
        self.robot, self.body, self.mapper, self.snapshot = robot, body, mapper, snapshot
        self.config, self.clock = config or ReplanningConfig(), clock or MeasuredClock()
        self.watch, self.seed = watch, seed
        self.tracker = BaseTracker(self.config.tracker)
        self.plan: PlanResult | None = None
        self.field: DistanceField | None = None
        self.report = DriveReport()
        self._owed = 0.0
        self._failures = 0
        self._retry_at = -math.inf
        self._to_goal = False
        self._mapped = False
        self._entries: list[Tensor] = []

    def drive_to(self, goal: Float[ndarray, "2"], final_yaw: float | None = None) -> DriveReport:
        """Look around, then map, plan and drive until the goal is reached or given up.

        Args:
            goal: x, y [m].
            final_yaw: heading to end with [rad]; any if None.
        """
        started, self.report, self.plan = self.robot.time, DriveReport(), None
        self._failures, self._retry_at, self._to_goal, self._entries = 0, -math.inf, False, []
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
        if not self._mapped:
            self.report.message = "no usable frame has come in yet"
            self._failures += 1
            self._retry_at = self.robot.time + self.config.retry
            return None
        self.field = self.snapshot()
        if self._still_good():
            if self._to_goal:
                return self.plan
            if not self._route(goal).reaches_goal and not self.tracker.finished:
                return self.plan
        route = self._route(goal)
        fresh = self._planned(route)
        self.report.plans += 1
        dead_end = fresh.success and not route.reaches_goal and self._leads_nowhere(route, goal)
        if fresh.success and not dead_end:
            self._failures, self._to_goal, self.report.message = 0, route.reaches_goal, ""
            return fresh
        if dead_end and route.entry is not None:
            self._entries.append(route.entry)
        self._failures += 1
        self._retry_at = self.robot.time + self.config.retry
        self.report.failed_plans += 1
        self.report.message = (
            "no way leads nearer to the goal" if dead_end else f"{fresh.status.value}: {fresh.message}"
        )
        logger.info("no plan: %s", self.report.message)
        return None

    def _route(self, goal: Float[ndarray, "2"]) -> Route:
        assert self.field is not None
        start = torch.as_tensor(self.robot.base_state()[:2], dtype=torch.float32)
        end = torch.as_tensor(goal, dtype=torch.float32)
        return grid_search(self.body, self.field, start, end, self.config.search, self._closed())

    def _leads_nowhere(self, route: Route, goal: Float[ndarray, "2"]) -> bool:
        """Whether the robot already stands where the route ends, or would only circle a walled-in goal."""
        if route.entry is not None:
            return float((route.path[-1] - route.path[0]).norm()) < 2 * self.config.search.spacing
        gaps = (route.path - torch.as_tensor(goal, dtype=torch.float32)).norm(dim=1)
        return float(gaps[0] - gaps[-1]) < self.config.search.spacing

    def _closed(self) -> Float[Tensor, "c 2"] | None:
        """Entries into blocked space that stayed blocked however often the robot stood before them and looked."""
        if not self._entries:
            return None
        entries = torch.stack(self._entries)
        visits = (torch.cdist(entries, entries) <= self.config.search.closed_radius).sum(dim=1)
        return entries[visits >= self.config.looks]

    def _planned(self, route: Route) -> PlanResult:
        """CHOMP from the route, or the route itself where CHOMP leaves it.

        The clearance asked for is what the route has, at most the margin; the cost still seeks more.
        """
        assert self.field is not None
        config = self.config
        path = Trajectory.through(route.path)
        found = check(self.body, path, self.field, config.chomp.validation)
        margin = min(config.margin, found.clearance - 0.005)
        validation = replace(config.chomp.validation, margin=margin)
        chomp = Chomp(self.body, replace(config.chomp, validation=validation), self.seed)
        guess = Trajectory.through(route.path, config.num_waypoints) if len(path) > 1 else path
        result = chomp.optimise(guess, self.field)
        if not result.success:
            verdict = check(self.body, path, self.field, validation)
            result = replace(
                result,
                trajectory=path,
                status=verdict.status,
                message=f"the searched route: {verdict.message}",
                clearance=verdict.clearance,
            )
        return result

    def _still_good(self) -> bool:
        """Whether what is left of the plan keeps its clearance on the new map."""
        if self.plan is None or self.field is None:
            return False
        left = self._remaining(self.plan.trajectory)
        clearance = check(self.body, left, self.field, self.config.chomp.validation).clearance
        wanted = min(self.config.margin, self.plan.clearance) - self.config.clearance_change
        return clearance >= wanted

    def _remaining(self, trajectory: Trajectory) -> Trajectory:
        """The part of a path ahead of the base, starting where the base stands."""
        here = torch.as_tensor(self.robot.base_state()[:2], dtype=trajectory.waypoints.dtype)
        nearest = int((trajectory.waypoints - here).norm(dim=1).argmin())
        ahead = torch.cat([here[None], trajectory.waypoints[nearest + 1 :]])
        return Trajectory.through(ahead)

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
