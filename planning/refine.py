"""Refine a path into a motion that wheels and motors can carry out, with clearances from the field (needs casadi).

Sequential convex programming in the manner of TrajOpt (Schulman et al., IJRR 2014): clearances are linearised about the
last motion and kept within a trust region, while the rule of the wheels, the limits and the time are exact.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from planning.drive_path import driveable
from planning.ends import check_ends
from planning.errors import ConfigError
from planning.linear_clearance import ClearanceModel
from planning.numbers import refuse_nan
from planning.protocols import CostField, DistanceField, SphereRobot
from planning.result import PlanResult, Status
from planning.timing import UNLIMITED, retime
from planning.trajectory import Trajectory
from planning.transcription import DriveLimits, Iterate, Transcription
from planning.validation import ValidationConfig, check


@dataclass(frozen=True)
class RefineConfig:
    """How a path is refined.

    Args:
        base_joints: names of the base's x, y and yaw where it drives on two wheels; empty for arms and for bases that
            can move sideways.
        reverse_speed: fastest driving backwards [m/s]; 0 forbids it.
        segment_time: [s] of a segment of the first guess; between `fewest` and `most` segments are used.
        fewest: segments.
        most: segments.
        margin: clearance [m] of the robot's spheres that is kept, or that of start and goal where they have less.
        self_margin: gap [m] between links that is kept in the same way.
        smoothness: weight [s] of squared accelerations against time.
        radius: first trust region [rad | m].
        iterations: most programmes solved for one first guess.
        improvement: relative gain below which refining ends.
        validation: the dense check that decides what success is.
    """

    base_joints: tuple[str, ...] = ("base_x", "base_y", "base_yaw")
    reverse_speed: float = 0.3
    segment_time: float = 0.25
    fewest: int = 30
    most: int = 90
    margin: float = 0.02
    self_margin: float = 0.005
    smoothness: float = 0.1
    radius: float = 0.3
    iterations: int = 12
    improvement: float = 0.01
    validation: ValidationConfig = field(default_factory=ValidationConfig)

    def __post_init__(self) -> None:
        refuse_nan(self)
        if len(self.base_joints) not in (0, 3):
            raise ConfigError(
                f"RefineConfig: base_joints must name x, y and yaw, or be empty, got {self.base_joints}."
            )
        if not self.segment_time > 0 or not 3 <= self.fewest <= self.most:
            raise ConfigError(
                "RefineConfig: segment_time must be positive and 3 <= fewest <= most, got "
                f"{self.segment_time:g} s, {self.fewest} and {self.most}."
            )
        not_negative = (self.reverse_speed, self.margin, self.self_margin, self.smoothness, self.improvement)
        if not all(value >= 0 for value in not_negative) or not self.radius > 0 or self.iterations < 1:
            raise ConfigError(
                "RefineConfig: reverse_speed, margins, smoothness and improvement must not be negative, radius and "
                f"iterations must be positive, got {self}."
            )


SLACK_COST = 1000.0  # [s/m]
SMALLEST_RADIUS = 0.01  # [rad | m]
SHORTFALL = 0.001  # [m] of the margins, summed, with which refining may end


class Refiner:
    """Refines trajectories of one robot.

    Args:
        robot: what moves.
        acceleration_limits: (dof,) [rad/s^2 | m/s^2], positive; the base's x entry is for driving, its y entry unused.
        config: see `RefineConfig`.

    Raises:
        ConfigError: if limits are not positive and finite, or a base joint is not the robot's.
    """

    def __init__(
        self,
        robot: SphereRobot,
        acceleration_limits: Float[Tensor, " dof"],
        config: RefineConfig | None = None,
    ) -> None:
        self.robot, self.config = robot, config or RefineConfig()
        self._accelerations = acceleration_limits.double()
        self._base = _columns(robot, self.config.base_joints)
        velocity = robot.velocity_limits.double()
        for name, limits in (("velocity", velocity), ("acceleration", self._accelerations)):
            if limits.shape != (robot.num_dofs,) or not (limits > 0).all() or not limits.isfinite().all():
                raise ConfigError(
                    f"Refiner: {name} limits must be {robot.num_dofs} positive finite numbers, one a joint, "
                    f"got {limits.tolist()}."
                )
        lower, upper = robot.joint_limits.double().unbind(dim=1)
        self._limits = DriveLimits(
            lower.numpy(),
            upper.numpy(),
            velocity.numpy(),
            self._accelerations.numpy(),
            self.config.reverse_speed,
        )
        self._programmes: dict[int, Transcription] = {}

    def refine(self, trajectory: Trajectory, sdf: DistanceField | CostField) -> PlanResult:
        """A timed motion from the same start to the same goal, up to whole turns of the base.

        Args:
            trajectory: a path, best a free one such as CHOMP's; its times are not used.
            sdf: the field to keep clear of.

        Returns:
            A result whose trajectory keeps velocity and acceleration limits and, where the robot has wheels, moves its
            base along the mean heading of every segment; SUCCESS if it also passed the dense check.

        Raises:
            TrajectoryError: if the trajectory does not fit the robot.
        """
        started, best = time.perf_counter(), None
        path, config = trajectory.waypoints.double().numpy(), self.config
        ends = check_ends(self.robot, trajectory, sdf, config.validation)
        if not ends.success:
            return _unrefined(trajectory, ends.status, ends.message, ends.clearance, started)
        clearances = ClearanceModel(
            self.robot, sdf, path[[0, -1]], config.margin, config.self_margin, config.validation.workspace
        )
        for first in self._guesses(path):
            result = self._from(first, clearances, sdf, started)
            if result is not None and result.success:
                return result
            best = best or result
        if best is None:
            given = check(self.robot, trajectory, sdf, config.validation)
            status = Status.NO_PATH if given.success else given.status
            text = f"no motion keeps the limits and the rule of the wheels near the path; {given.message}"
            return _unrefined(trajectory, status, text, given.clearance, started)
        return best

    def _guesses(self, path: Float[np.ndarray, "n dof"]) -> list[Iterate]:
        """The path driven forwards and in reverse, that which turns less first."""
        if not self._base:
            return [self._timed(path, np.zeros(len(path) - 1))]
        ways = [driveable(path, self._base, backwards=False)]
        if self.config.reverse_speed > 0 and ways[0][1].any():
            ways.append(driveable(path, self._base, backwards=True))
        ways.sort(key=lambda way: float(np.abs(np.diff(way[0][:, self._base[2]])).sum()))
        return [self._timed(*way) for way in ways]

    def _timed(self, path: Float[np.ndarray, "n dof"], driven: Float[np.ndarray, " segments"]) -> Iterate:
        """Evenly timed states along a path, as fast as its joints allow."""
        config = self.config
        limits = self.robot.velocity_limits.double(), self._accelerations
        arc = np.r_[0.0, np.cumsum(driven)]
        # The distance is one more joint, so that the times are those of wheels.
        extended = np.c_[path, arc]
        if self._base:
            extra = [torch.cat([limit, limit[self._base[:1]]]) for limit in limits]
            for limit in extra:
                limit[self._base[:2]] = UNLIMITED
        else:
            extra = [torch.cat([limit, torch.ones(1, dtype=limit.dtype)]) for limit in limits]
        through = Trajectory(torch.from_numpy(extended), torch.arange(len(extended), dtype=torch.float64))
        timed = retime(through, *extra)
        count = int(np.clip(np.ceil(timed.duration / config.segment_time), config.fewest, config.most))
        # Programmes are built once a length; a few lengths serve all.
        count = min(-(-count // 15) * 15, config.most)
        even = timed.resampled(count + 1).waypoints.numpy()
        return Iterate(even[:, :-1].copy(), np.diff(even[:, -1]), timed.duration / count)

    def _from(
        self, motion: Iterate, clearances: ClearanceModel, sdf: DistanceField | CostField, started: float
    ) -> PlanResult | None:
        """Solve programme after programme within a trust region; None if not even the first is solved."""
        config, radius, history = self.config, self.config.radius, list[float]()
        programme, model = self._programme(len(motion.driven)), clearances.at(motion.q)
        for _ in range(config.iterations):
            step = programme.solve(motion, model, radius)
            if step is not None:
                there = clearances.at(step.q)
                cost = programme.cost(step, motion.step) + SLACK_COST * there.violation
                gained = programme.cost(motion, motion.step) + SLACK_COST * model.violation - cost
                # The guess breaks limits, so the first programme's motion is taken as it is, unless the field is NaN.
                better = gained > 0 if history else math.isfinite(cost)
            if step is None or not better:
                radius /= 4
                if radius < SMALLEST_RADIUS:
                    break
                continue
            done = bool(history) and gained < config.improvement * cost and there.violation < SHORTFALL
            motion, model, radius = step, there, 1.5 * radius
            history.append(cost)
            if done:
                break
        return self._checked(motion, sdf, tuple(history), started) if history else None

    def _programme(self, segments: int) -> Transcription:
        if segments not in self._programmes:
            self._programmes[segments] = Transcription(
                segments, self._base, self._limits, self.config.smoothness, SLACK_COST
            )
        return self._programmes[segments]

    def _checked(
        self, motion: Iterate, sdf: DistanceField | CostField, history: tuple[float, ...], started: float
    ) -> PlanResult:
        times = motion.step * torch.arange(len(motion.q), dtype=torch.float64)
        trajectory = Trajectory(torch.from_numpy(motion.q.copy()), times)
        verdict = check(self.robot, trajectory, sdf, self.config.validation)
        seconds = time.perf_counter() - started
        return PlanResult(
            trajectory, verdict.status, verdict.message, verdict.clearance, history, len(history), seconds
        )


def _unrefined(
    trajectory: Trajectory, status: Status, message: str, clearance: float, started: float
) -> PlanResult:
    return PlanResult(trajectory, status, message, clearance, (), 0, time.perf_counter() - started)


def _columns(robot: SphereRobot, names: Sequence[str]) -> list[int]:
    missing = [name for name in names if name not in robot.joint_names]
    if missing:
        raise ConfigError(
            f"Refiner: {', '.join(missing)} is no joint of the robot, which has {', '.join(robot.joint_names)}; "
            "set RefineConfig.base_joints, () for a robot without wheels."
        )
    return [robot.joint_names.index(name) for name in names]
