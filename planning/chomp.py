"""CHOMP: covariant Hamiltonian optimisation for motion planning (Zucker et al., IJRR 2013)."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from planning.errors import ConfigError
from planning.limits import project_to_limits
from planning.metric import Metric, MetricConfig
from planning.objective import Evaluation, Objective, ObjectiveConfig
from planning.protocols import CostField, DistanceField, SphereRobot
from planning.result import PlanResult, Status
from planning.trajectory import Trajectory
from planning.validation import Validation, ValidationConfig, check, check_ends
from planning.workspace import Workspace

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ChompConfig:
    """How CHOMP descends and when it stops.

    Args:
        eps: distance [m] from a surface at which the obstacle cost starts; a CostField brings its own.
        metric: derivatives whose squares are the smoothness, and with it the metric A of the update.
        objective: weights of the parts of the objective.
        validation: the dense check that has the last word.
        step: first step size 1 / eta of the update; it grows by a fifth after each decrease and halves after
            each increase of the objective (which is undone).
        max_update: no joint of any waypoint moves further than this in one iteration [rad | m].
        max_iterations: most evaluations of the objective.
        tolerance: the cost is on a plateau when it fell by less than this fraction over `patience`
            iterations.
        patience: see tolerance.
        polish: most iterations after the trajectory is free, for smoothness.
        max_tightenings: how often a plateau in collision is answered by a four times smaller smoothness
            weight (waypoints collide) or by twice as many states a segment (only the motion in between does).
        perturbation: size [rad | m] of the smooth random offset given to a trajectory that starts in
            collision, so that one through the middle of an obstacle can choose a side.
    """

    eps: float = 0.1
    metric: MetricConfig = field(default_factory=MetricConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    step: float = 1.0
    max_update: float = 0.1
    max_iterations: int = 300
    tolerance: float = 1e-2
    patience: int = 10
    polish: int = 50
    max_tightenings: int = 4
    perturbation: float = 1e-3

    def __post_init__(self) -> None:
        if min(self.eps, self.step, self.max_update) <= 0 or self.patience < 1:
            raise ConfigError(
                f"ChompConfig: eps, step, max_update and patience must be positive, got {self}."
            )


class Chomp:
    """Bends a trajectory out of collision and smooths it, its start and goal held exactly."""

    def __init__(self, robot: SphereRobot, config: ChompConfig | None = None, seed: int = 0) -> None:
        self.robot, self.config, self.seed = robot, config or ChompConfig(), seed

    def optimise(
        self, trajectory: Trajectory, sdf: DistanceField | CostField, deadline: float | None = None
    ) -> PlanResult:
        """Optimise a trajectory in a field.

        Args:
            trajectory: the first guess; its times are kept.
            sdf: distances, or a cost field that is then descended as it is.
            deadline: wall time [s] allowed for the descent; the final check comes on top.

        Returns:
            The best trajectory found (valid before free before cheap), with the verdict of the dense check
            on it.

        Raises:
            TrajectoryError: if the trajectory does not fit the robot.
        """
        robot, config = self.robot, self.config
        started = time.perf_counter()
        history: list[float] = []
        late = _Deadline(started, deadline)
        verdict = check_ends(robot, trajectory, sdf, config.validation)
        if verdict.success and len(trajectory) < 3:
            verdict = check(robot, trajectory, sdf, config.validation)
        if not verdict.success or len(trajectory) < 3:
            return _result(trajectory, verdict, history, started)

        workspace = Workspace(robot, sdf, config.eps, config.validation.workspace)
        objective = Objective(robot, workspace, Metric(len(trajectory), config.metric), config.objective)
        q = trajectory.waypoints.clone()
        if not late() and not objective(q).free:
            q = self._perturbed(q, objective.metric)
        best, best_verdict = trajectory, None
        for _ in range(config.max_tightenings + 1):
            q, free = self._descend(objective, q, history, late)
            candidate = Trajectory(q, trajectory.times)
            verdict = check(robot, candidate, sdf, config.validation)
            if best_verdict is None or _rank(verdict) > _rank(best_verdict):
                best, best_verdict = candidate, verdict
            if verdict.success or verdict.status is Status.INVALID_FIELD or late():
                break
            objective = objective.tightened(free)
        assert best_verdict is not None
        return _result(best, best_verdict, history, started)

    def _descend(
        self, objective: Objective, q: Float[Tensor, "n dof"], history: list[float], late: _Deadline
    ) -> tuple[Float[Tensor, "n dof"], bool]:
        """Covariant gradient descent to a plateau; the best waypoints seen and whether they are free."""
        config, step, polished = self.config, self.config.step, 0
        now = objective(q)
        best_q, best = q, now
        first = len(history)
        while len(history) < config.max_iterations and math.isfinite(now.total) and not late():
            history.append(now.total)
            candidate = self._updated(q, now, step, objective.metric)
            then = objective(candidate)
            if then.total < now.total:
                q, now, step = candidate, then, 1.2 * step
                if now.free or not best.free:
                    best_q, best = q, now
            else:
                step *= 0.5
            polished += best.free
            if polished >= config.polish or self._plateau(history[first:]):
                break
        return best_q, best.free

    def _updated(
        self, q: Float[Tensor, "n dof"], now: Evaluation, step: float, metric: Metric
    ) -> Float[Tensor, "n dof"]:
        """q - step A^-1 grad U (CHOMP, equation 8), each joint capped, projected to the joint limits."""
        update = step * metric.solve(now.gradient)
        update *= (self.config.max_update / update.abs().amax(dim=0).clamp_min(1e-12)).clamp_max(1.0)
        interior = project_to_limits(q[1:-1] - update, self.robot.joint_limits, metric)
        return torch.cat([q[:1], interior, q[-1:]])

    def _plateau(self, totals: list[float]) -> bool:
        config = self.config
        if len(totals) <= config.patience:
            return False
        before, now = totals[-1 - config.patience], totals[-1]
        return before - now <= config.tolerance * abs(before)

    def _perturbed(self, q: Float[Tensor, "n dof"], metric: Metric) -> Float[Tensor, "n dof"]:
        """Interior waypoints offset by smooth noise A^-1 z of the configured size."""
        generator = torch.Generator().manual_seed(self.seed)
        noise = metric.solve(torch.randn(len(q) - 2, q.shape[1], generator=generator).to(q))
        noise *= self.config.perturbation / noise.abs().amax(dim=0).clamp_min(1e-12)
        interior = project_to_limits(q[1:-1] + noise, self.robot.joint_limits, metric)
        return torch.cat([q[:1], interior, q[-1:]])


@dataclass(frozen=True)
class _Deadline:
    started: float
    seconds: float | None

    def __call__(self) -> bool:
        return self.seconds is not None and time.perf_counter() - self.started >= self.seconds


def _rank(verdict: Validation) -> tuple[bool, float]:
    """Valid first, then by clearance; a clearance that is not a number is worst."""
    return verdict.success, -math.inf if math.isnan(verdict.clearance) else verdict.clearance


def _result(trajectory: Trajectory, verdict: Validation, history: list[float], started: float) -> PlanResult:
    seconds = time.perf_counter() - started
    logger.debug("CHOMP: %s after %d iterations, %s", verdict.status.value, len(history), verdict.message)
    return PlanResult(
        trajectory, verdict.status, verdict.message, verdict.clearance, tuple(history), len(history), seconds
    )
