"""From a start and a goal to a checked trajectory: CHOMP first, a sampled path where it gets stuck."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from planning.chomp import Chomp, ChompConfig
from planning.ends import check_ends, offered
from planning.errors import ConfigError, TrajectoryError
from planning.exact_shape import exact_shape
from planning.initialise import NoPath, RrtConfig, rrt_connect
from planning.numbers import refuse_nan
from planning.protocols import CostField, DistanceField, SphereRobot
from planning.result import PlanResult, Status
from planning.threads import one_thread
from planning.trajectory import Trajectory
from planning.validation import check

logger = logging.getLogger(__name__)

SEARCH_SHARE = 0.6  # of the time left before a deadline; the rest is for smoothing and checking


@dataclass(frozen=True)
class PlannerConfig:
    """How a plan is sought.

    Args:
        num_waypoints: of the trajectories, at least.
        spacing: longest distance of waypoints along a searched path in joint space [rad | m].
        duration: [s] given to trajectories before they are retimed.
        chomp: the optimiser, whose validation decides what success is.
        rrt: the search. Its margin is above the one that is checked, since its edges are tested more
            coarsely.
    """

    num_waypoints: int = 50
    spacing: float = 0.15
    duration: float = 5.0
    chomp: ChompConfig = field(default_factory=ChompConfig)
    rrt: RrtConfig = field(default_factory=RrtConfig)

    def __post_init__(self) -> None:
        refuse_nan(self)
        if self.num_waypoints < 3:
            raise ConfigError(f"PlannerConfig: num_waypoints must be at least 3, got {self.num_waypoints}.")


class Planner:
    """Plans by search and optimisation; whatever is returned as a success passed the dense check.

    Where robot and field can be compiled a search costs milliseconds, so it comes first and CHOMP shortens and smooths
    its path. Elsewhere CHOMP bends the straight line (or the warm start) first, and searches only where that collides.
    If CHOMP leaves the free path of a search, that path itself is the plan.
    """

    def __init__(self, robot: SphereRobot, config: PlannerConfig | None = None, seed: int = 0) -> None:
        self.robot, self.config, self.seed = robot, config or PlannerConfig(), seed

    @one_thread
    def plan(
        self,
        start: Float[Tensor, " dof"],
        goal: Float[Tensor, " dof"] | Float[Tensor, "g dof"],
        sdf: DistanceField | CostField,
        warm_start: Trajectory | None = None,
        deadline: float | None = None,
    ) -> PlanResult:
        """Plan from start to a goal, or to whichever of several is reached best [rad | m].

        Args:
            start: exactly the first waypoint.
            goal: exactly the last waypoint.
            sdf: the field to keep clear of.
            warm_start: a trajectory to bend first, such as the last plan; its ends are replaced by start and
                goal.
            deadline: wall time [s] for the whole. The first plan of a process also loads or compiles kernels.

        Raises:
            TrajectoryError: if start, goal or warm start do not fit the robot.
        """
        self._check(start, goal, warm_start)
        config, started = self.config, time.perf_counter()

        def left() -> float | None:
            return None if deadline is None else max(0.0, deadline - (time.perf_counter() - started))

        goals = goal.reshape(-1, goal.shape[-1])
        lines = [Trajectory.line(start, g, config.num_waypoints, config.duration) for g in goals]
        verdicts = [check_ends(self.robot, line, sdf, config.chomp.validation) for line in lines]
        lines = [line for line, verdict in zip(lines, verdicts, strict=True) if verdict.success]
        if not lines:
            line = Trajectory.line(start, goals[0], config.num_waypoints, config.duration)
            message, nearest = offered(self.robot, line, verdicts[0], sdf, config.chomp.validation, left())
            seconds, first = time.perf_counter() - started, verdicts[0]
            return PlanResult(line, first.status, message, first.clearance, (), 0, seconds, nearest)
        for line in lines:
            if line.joint_path_length == 0:
                stays = check(self.robot, line, sdf, config.chomp.validation)
                message, seconds = f"start is the goal; {stays.message}", time.perf_counter() - started
                return PlanResult(line, stays.status, message, stays.clearance, (), 0, seconds)
        guesses = [self._warm(warm_start, line) for line in lines]
        chomp = Chomp(self.robot, config.chomp, self.seed)
        unaided = None
        if warm_start is not None or exact_shape(self.robot, sdf, config.rrt.workspace) is None:
            unaided = chomp.optimise(guesses, sdf, left())
            if unaided.success:
                return replace(unaided, seconds=time.perf_counter() - started)
        path = self._search(start, torch.stack([line.waypoints[-1] for line in lines]), sdf, left())
        if isinstance(path, NoPath):
            unaided = unaided or chomp.optimise(guesses, sdf, left())
            if not unaided.success:
                message = f"{path.message}; CHOMP from the first guess: {unaided.message}"
                unaided = replace(unaided, status=Status.NO_PATH, message=message)
            return replace(unaided, seconds=time.perf_counter() - started)
        result = self._smoothed(path, sdf, chomp, left())
        return replace(result, seconds=time.perf_counter() - started)

    def _check(self, start: Tensor, goal: Tensor, warm_start: Trajectory | None) -> None:
        """Raise a TrajectoryError where something does not fit the robot."""
        joints = self.robot.joint_names
        given = {"start": start, "goal": goal}
        if warm_start is not None:
            given["warm_start"] = warm_start.waypoints
        for name, q in given.items():
            if q.ndim == 0 or q.numel() == 0 or q.shape[-1] != len(joints):
                raise TrajectoryError(
                    f"Planner.plan: {name} has shape {tuple(q.shape)}, but the robot has {len(joints)} joints: "
                    f"{', '.join(joints)}."
                )
            if not torch.isfinite(q).all():
                raise TrajectoryError(f"Planner.plan: {name} must be finite, got {q.tolist()}.")

    def _search(
        self,
        start: Float[Tensor, " dof"],
        goals: Float[Tensor, "g dof"],
        sdf: DistanceField | CostField,
        seconds: float | None,
    ) -> Float[Tensor, "k dof"] | NoPath:
        """A free path to the first goal that a search reaches, in a share of the time that is left."""
        rrt = self.config.rrt
        if seconds is not None:
            rrt = replace(rrt, seconds=min(rrt.seconds, SEARCH_SHARE * seconds))
        path: Float[Tensor, "k dof"] | NoPath = NoPath("no goal")
        for goal in goals:
            path = rrt_connect(
                self.robot, sdf, start, goal, replace(rrt, seconds=rrt.seconds / len(goals)), self.seed
            )
            if not isinstance(path, NoPath):
                break
        return path

    def _smoothed(
        self,
        path: Float[Tensor, "k dof"],
        sdf: DistanceField | CostField,
        chomp: Chomp,
        seconds: float | None,
    ) -> PlanResult:
        """CHOMP from a searched path, or where it leaves what is free, that path."""
        config = self.config
        guess = Trajectory.through(_subdivided(path, config), duration=config.duration)
        result = chomp.optimise(guess, sdf, seconds)
        if result.success:
            return result
        logger.info("CHOMP left the free path of the search (%s); returning that path", result.message)
        searched = Trajectory.through(path, duration=config.duration)
        verdict = check(self.robot, searched, sdf, config.chomp.validation)
        return replace(
            result,
            trajectory=searched,
            status=verdict.status,
            message=f"path of the search, not optimised: {verdict.message}",
            clearance=verdict.clearance,
        )

    def _warm(self, warm_start: Trajectory | None, line: Trajectory) -> Trajectory:
        """The warm start with the ends of the line, or the line."""
        if warm_start is None or len(warm_start) < 3:
            return line
        waypoints = warm_start.waypoints.clone()
        waypoints[0], waypoints[-1] = line.waypoints[0], line.waypoints[-1]
        return Trajectory(waypoints, warm_start.times)


def _subdivided(path: Float[Tensor, "k dof"], config: PlannerConfig) -> Float[Tensor, "n dof"]:
    """A path with points added on its edges; its vertices stay, since cutting their corners may collide."""
    lengths = path.diff(dim=0).norm(dim=1).tolist()
    spacing = min(config.spacing, sum(lengths) / (config.num_waypoints - 1))
    parts = []
    for a, b, length in zip(path[:-1], path[1:], lengths, strict=True):
        count = max(1, math.ceil(length / spacing - 1e-9))
        parts.append(torch.lerp(a, b, (torch.arange(count) / count).to(path)[:, None]))
    return torch.cat([*parts, path[-1:]])
