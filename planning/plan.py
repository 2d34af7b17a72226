"""From a start and a goal to a checked trajectory: CHOMP first, a sampled path where it gets stuck."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field, replace

from jaxtyping import Float
from torch import Tensor

from planning.chomp import Chomp, ChompConfig
from planning.errors import ConfigError
from planning.initialise import NoPath, RrtConfig, rrt_connect
from planning.protocols import CostField, DistanceField, SphereRobot
from planning.result import PlanResult, Status
from planning.trajectory import Trajectory
from planning.validation import check, check_ends

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlannerConfig:
    """How a plan is sought.

    Args:
        num_waypoints: of the trajectories.
        duration: [s] given to trajectories before they are retimed.
        chomp: the optimiser, whose validation decides what success is.
        rrt: the search. Its margin is above the one that is checked, since its edges are tested more
            coarsely.
    """

    num_waypoints: int = 50
    duration: float = 5.0
    chomp: ChompConfig = field(default_factory=ChompConfig)
    rrt: RrtConfig = field(default_factory=RrtConfig)

    def __post_init__(self) -> None:
        if self.num_waypoints < 3:
            raise ConfigError(f"PlannerConfig: num_waypoints must be at least 3, got {self.num_waypoints}.")


class Planner:
    """Plans by optimisation, and falls back on search.

    1. CHOMP from the warm start or the straight line. 2. If that collides, CHOMP from a path of RRT-Connect.
    3. If that collides, the searched path itself. Whatever is returned as a success passed the dense check.
    """

    def __init__(self, robot: SphereRobot, config: PlannerConfig | None = None, seed: int = 0) -> None:
        self.robot, self.config, self.seed = robot, config or PlannerConfig(), seed

    def plan(
        self,
        start: Float[Tensor, " dof"],
        goal: Float[Tensor, " dof"],
        sdf: DistanceField | CostField,
        warm_start: Trajectory | None = None,
        deadline: float | None = None,
    ) -> PlanResult:
        """Plan from start to goal [rad | m].

        Args:
            start: exactly the first waypoint.
            goal: exactly the last waypoint.
            sdf: the field to keep clear of.
            warm_start: a trajectory to bend first, such as the last plan; its ends are replaced by start and
                goal.
            deadline: wall time [s] for the whole; checks come on top.

        Raises:
            TrajectoryError: if start, goal or warm start do not fit the robot.
        """
        config, started = self.config, time.perf_counter()

        def left() -> float | None:
            return None if deadline is None else max(0.0, deadline - (time.perf_counter() - started))

        chomp = Chomp(self.robot, config.chomp, self.seed)
        line = Trajectory.line(start, goal, config.num_waypoints, config.duration)
        verdict = check_ends(self.robot, line, sdf, config.chomp.validation)
        if not verdict.success:
            seconds = time.perf_counter() - started
            return PlanResult(line, verdict.status, verdict.message, verdict.clearance, (), 0, seconds)
        first = chomp.optimise(self._warm(warm_start, line), sdf, left())
        if first.success:
            return replace(first, seconds=time.perf_counter() - started)

        seconds_left = left()
        rrt = (
            config.rrt
            if seconds_left is None
            else replace(config.rrt, seconds=min(config.rrt.seconds, seconds_left))
        )
        path = rrt_connect(self.robot, sdf, start, goal, rrt, self.seed)
        if isinstance(path, NoPath):
            message = f"{path.message}; CHOMP from the first guess: {first.message}"
            return replace(
                first, status=Status.NO_PATH, message=message, seconds=time.perf_counter() - started
            )
        second = chomp.optimise(Trajectory.through(path, config.num_waypoints, config.duration), sdf, left())
        if second.success:
            return replace(second, seconds=time.perf_counter() - started)

        logger.info("CHOMP left the free path of the search (%s); returning that path", second.message)
        searched = Trajectory.through(path, duration=config.duration)
        verdict = check(self.robot, searched, sdf, config.chomp.validation)
        return replace(
            second,
            trajectory=searched,
            status=verdict.status,
            message=f"path of the search, not optimised: {verdict.message}",
            clearance=verdict.clearance,
            seconds=time.perf_counter() - started,
        )

    def _warm(self, warm_start: Trajectory | None, line: Trajectory) -> Trajectory:
        """The warm start with the ends of the line, or the line."""
        if warm_start is None or len(warm_start) < 3:
            return line
        waypoints = warm_start.waypoints.clone()
        waypoints[0], waypoints[-1] = line.waypoints[0], line.waypoints[-1]
        return Trajectory(waypoints, warm_start.times)
