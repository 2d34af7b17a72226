"""From a problem to a timed, checked trajectory."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch

from planning.chomp import ChompConfig
from planning.descent import DescentConfig
from planning.errors import ProblemError
from planning.initialise import RrtConfig
from planning.numbers import refuse_nan
from planning.objective import ObjectiveConfig
from planning.plan import Planner, PlannerConfig
from planning.problems import Problem
from planning.protocols import SphereRobot
from planning.timing import retime
from planning.trajectory import Trajectory
from planning.validation import ValidationConfig


@runtime_checkable
class PosableRobot(SphereRobot, Protocol):
    """A robot whose joints can be held at given values."""

    @property
    def holdable_joints(self) -> tuple[str, ...]:
        """Joints that have a value of their own."""
        ...

    def with_fixed(self, values: dict[str, float]) -> SphereRobot:
        """The robot with these joints [rad | m] held and the others planned."""
        ...


def _planner() -> PlannerConfig:
    # Goals are a few millimetres from the shelves they stand on, so all margins are small.
    # The fine cover protrudes by 1.5 mm, so half a millimetre within it is still clear of the
    # robot itself, and so are two covers that overlap by as much as one protrudes.
    validation = ValidationConfig(max_joint_step=0.01, margin=-0.0005, self_margin=-0.0015)
    return PlannerConfig(
        num_waypoints=40,
        spacing=0.15,
        chomp=ChompConfig(
            eps=0.03,
            objective=ObjectiveConfig(smoothness_weight=0.02, self_collision_eps=0.01),
            descent=DescentConfig(polish=10, patience=5, tolerance=2e-2),
            validation=validation,
            max_iterations=60,
            max_tightenings=1,
            restarts=0,
        ),
        rrt=RrtConfig(
            min_margin=-0.0005,
            margin=0.005,
            reach=0.5,
            resolution=0.04,
            shortcut_rounds=250,
            seconds=5.0,
            candidates=6,
            self_margin=-0.0015,
        ),
    )


@dataclass(frozen=True)
class SolveConfig:
    """How problems are solved.

    Args:
        planner: search, optimisation and check.
        acceleration_time: time [s] in which every joint gets from rest to its velocity limit, which sets its
            acceleration limit.
        seed: of the search.
    """

    planner: PlannerConfig = field(default_factory=_planner)
    acceleration_time: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        refuse_nan(self)


class Solver:
    """Solves problems for one robot; joints that a problem does not plan are held where it puts them."""

    def __init__(self, robot: SphereRobot, config: SolveConfig | None = None) -> None:
        self._robot, self.config = robot, config or SolveConfig()
        self._posed: dict[tuple, SphereRobot] = {}

    def solve(self, problem: Problem, deadline: float | None = None) -> dict[str, Any]:
        """Plan and time one problem.

        Returns:
            A JSON-like object: set, index, status, message, seconds (wall, from the problem to the timed trajectory),
            waypoints (joint values in the problem's order, start and goal included), times and clearance. Without
            success, waypoints and times are those of the best trajectory found.
        """
        robot = self.robot_for(problem)
        order = [robot.joint_names.index(name) for name in problem.joints]
        back = torch.tensor(order).argsort()
        field_ = problem.field
        started = time.perf_counter()
        result = Planner(robot, self.config.planner, self.config.seed).plan(
            problem.start[back], problem.goal[back], field_, deadline=deadline
        )
        timed = self._timed(robot, result.trajectory)  # along the path that was checked
        seconds = time.perf_counter() - started
        return {
            "set": problem.set,
            "index": problem.index,
            "status": result.status.value,
            "message": result.message,
            "seconds": seconds,
            "waypoints": timed.waypoints[:, order].tolist(),
            "times": timed.times.tolist(),
            "clearance": result.clearance,
        }

    def _timed(self, robot: SphereRobot, trajectory: Trajectory) -> Trajectory:
        velocity = robot.velocity_limits.to(trajectory.waypoints)
        return retime(trajectory, velocity, velocity / self.config.acceleration_time)

    def robot_for(self, problem: Problem) -> SphereRobot:
        """The robot with its unplanned joints where a problem has them; raises `ProblemError` if it does not fit."""
        missing = sorted(set(problem.joints) - set(self._robot.joint_names))
        if missing:
            raise ProblemError(
                f"{problem.set} {problem.index}: the robot has no joints {missing}; it plans {self._robot.joint_names}."
            )
        if not isinstance(self._robot, PosableRobot):
            if set(problem.joints) != set(self._robot.joint_names):
                raise ProblemError(
                    f"{problem.set} {problem.index}: the robot cannot hold joints that are not planned."
                )
            return self._robot
        allowed = set(self._robot.holdable_joints) - set(problem.joints)
        held = {name: value for name, value in problem.posture.items() if name in allowed}
        key = tuple(sorted(held.items()))
        if key not in self._posed:
            self._posed[key] = self._robot.with_fixed(held)
        return self._posed[key]
