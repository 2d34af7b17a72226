"""CHOMP: covariant Hamiltonian optimisation for motion planning (Zucker et al., IJRR 2013)."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from planning.constraints import Constraint, project_to_constraints, violation
from planning.descent import Descent, DescentConfig, descend
from planning.ends import check_ends, offered
from planning.errors import ConfigError, TrajectoryError
from planning.hamiltonian import shaken
from planning.limits import project_to_limits
from planning.metric import Metric, MetricConfig
from planning.numbers import refuse_nan
from planning.objective import Objective, ObjectiveConfig
from planning.protocols import CostField, DistanceField, SphereRobot
from planning.result import PlanResult, Status
from planning.threads import one_thread
from planning.trajectory import Trajectory
from planning.validation import Validation, ValidationConfig, check
from planning.workspace import Workspace

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ChompConfig:
    """How CHOMP descends and what it does where it gets stuck.

    Args:
        eps: distance [m] from a surface at which the obstacle cost starts; a CostField brings its own.
        metric: derivatives whose squares are the smoothness, and with it the metric A of the update.
        objective: weights of the parts of the objective.
        descent: steps of the gradient descent, and when it ends.
        validation: the dense check that has the last word.
        max_iterations: most evaluations of the objective.
        max_tightenings: how often a plateau in collision is answered by a four times smaller smoothness
            weight (waypoints collide) or by twice as many states a segment (only the motion in between does).
        restarts: how often a random smooth momentum (Hamiltonian Monte Carlo) throws the trajectories out of a
            local minimum after that.
        temperature: of the first restart; its root is the size of the momentum [rad | m]. Each restart has half of it.
        perturbation: size [rad | m] of the smooth random offset given to a trajectory that starts in
            collision, so that one through the middle of an obstacle can choose a side.
        constraint_tolerance: largest violation of a constraint [rad | m] that counts as rounding.
    """

    eps: float = 0.1
    metric: MetricConfig = field(default_factory=MetricConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    descent: DescentConfig = field(default_factory=DescentConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    max_iterations: int = 300
    max_tightenings: int = 4
    restarts: int = 2
    temperature: float = 0.5
    perturbation: float = 1e-3
    constraint_tolerance: float = 1e-3

    def __post_init__(self) -> None:
        refuse_nan(self)
        if min(self.eps, self.descent.step, self.descent.max_update) <= 0 or self.descent.patience < 1:
            raise ConfigError(
                f"ChompConfig: eps, step, max_update and patience must be positive, got {self}."
            )


class Chomp:
    """Bends trajectories out of collision and smooths them, their start and goal held exactly.

    Args:
        robot: what moves.
        config: see `ChompConfig`.
        seed: of the perturbation and of restarts.
    """

    def __init__(self, robot: SphereRobot, config: ChompConfig | None = None, seed: int = 0) -> None:
        self.robot, self.config, self.seed = robot, config or ChompConfig(), seed

    @one_thread
    def optimise(
        self,
        trajectory: Trajectory | Sequence[Trajectory],
        sdf: DistanceField | CostField,
        deadline: float | None = None,
        constraints: Sequence[Constraint] = (),
    ) -> PlanResult:
        """Optimise a trajectory, or a batch of them of which the best is returned, in a field.

        Args:
            trajectory: the first guess, or several with as many waypoints each (from other sides, to other goals); its
                times are kept.
            sdf: distances, or a cost field that is then descended as it is.
            deadline: wall time [s] after which the best trajectory so far is returned, checked.
            constraints: kept by projection; one with `goal_only` replaces the last waypoint as the goal.

        Returns:
            The best trajectory found (valid before free before cheap), with the verdict of the dense check
            on it.

        Raises:
            TrajectoryError: if the trajectories do not fit the robot or each other.
        """
        started = time.perf_counter()
        guesses = [trajectory] if isinstance(trajectory, Trajectory) else list(trajectory)
        self._check(guesses)
        config, run = self.config, _Run(self.robot, sdf, self.config, constraints)
        guesses, verdict = run.with_valid_ends(guesses)
        if verdict is not None:
            left = None if deadline is None else deadline - (time.perf_counter() - started)
            message, nearest = offered(self.robot, guesses[0], verdict, sdf, config.validation, left)
            result = _result(guesses[0], replace(verdict, message=message), [], started)
            return replace(result, nearest_free=nearest)
        if len(guesses[0]) < 3:
            return _result(guesses[0], run.judge(guesses[0]), [], started)
        timer = time.perf_counter()
        best = _Best(guesses[0], run.judge(guesses[0])) if deadline is not None else None
        reserve = 1.3 * (time.perf_counter() - timer)  # a check takes about as long as the first one did
        late = _Deadline(started, deadline, reserve)
        if best is not None and late():
            return _result(best.trajectory, best.verdict, [], started)

        metric = Metric(len(guesses[0]), config.metric, free_goal=any(c.goal_only for c in constraints))
        workspace = Workspace(self.robot, sdf, config.eps, config.validation.workspace)
        objective = Objective(self.robot, workspace, metric, config.objective)
        generator = torch.Generator().manual_seed(self.seed)
        q = run.settled(torch.stack([guess.waypoints for guess in guesses]), metric)
        if not late() and not objective(q).free.all():
            q = self._perturbed(q, metric, generator, objective)
        history: list[float] = []
        for attempt in range(config.max_tightenings + config.restarts + 1):
            late.begin()
            descent = descend(
                objective,
                q,
                config.descent,
                lambda x: run.settled(x, metric),
                history,
                config.max_iterations,
                late,
            )
            best = run.best_of(descent, guesses, best, late)
            if descent.blind.all() and not best.verdict.success:
                best = _Best(best.trajectory, _without_gradient(best.verdict))
            if best.verdict.success or best.verdict.status is Status.INVALID_FIELD or late():
                break
            if len(history) >= config.max_iterations or attempt == config.max_tightenings + config.restarts:
                break
            q = descent.q
            if attempt < config.max_tightenings:
                objective = objective.tightened(bool(descent.free[descent.order()[0]]))
            else:
                temperature = config.temperature * 0.5 ** (attempt - config.max_tightenings)
                q = shaken(objective, q, temperature, generator, lambda x: run.settled(x, metric))
        assert best is not None
        return _result(best.trajectory, best.verdict, history, started)

    def _check(self, guesses: list[Trajectory]) -> None:
        if not guesses:
            raise TrajectoryError("Chomp.optimise: got no trajectory; at least one first guess is needed.")
        if len({len(guess) for guess in guesses}) != 1:
            raise TrajectoryError(
                f"Chomp.optimise: a batch needs as many waypoints each, got {[len(guess) for guess in guesses]}; "
                "use Trajectory.resampled."
            )

    def _perturbed(
        self, q: Float[Tensor, "b n dof"], metric: Metric, generator: torch.Generator, objective: Objective
    ) -> Float[Tensor, "b n dof"]:
        """Trajectories in collision, offset by smooth noise A^-1 z of the configured size."""
        interior = q[:, metric.interior]
        noise = metric.solve(torch.randn(interior.shape, generator=generator).to(q))
        noise *= self.config.perturbation / noise.abs().amax(dim=1, keepdim=True).clamp_min(1e-12)
        offset = q.clone()
        offset[:, metric.interior] += noise.where(~objective(q).free[:, None, None], 0.0)
        return offset


@dataclass(frozen=True)
class _Best:
    trajectory: Trajectory
    verdict: Validation

    @property
    def rank(self) -> tuple[bool, float]:
        """Valid first, then by clearance; a clearance that is not a number is worst."""
        clearance = self.verdict.clearance
        return self.verdict.success, -math.inf if math.isnan(clearance) else clearance


@dataclass(frozen=True)
class _Run:
    """One problem: the robot in a field, under constraints."""

    robot: SphereRobot
    sdf: DistanceField | CostField
    config: ChompConfig
    constraints: Sequence[Constraint]

    def with_valid_ends(self, guesses: list[Trajectory]) -> tuple[list[Trajectory], Validation | None]:
        """The guesses whose ends are valid; where none's are, the first one's verdict."""
        verdicts = []
        for guess in guesses:
            ends = guess
            if any(c.goal_only for c in self.constraints):  # the goal is still to be found
                ends = Trajectory(guess.waypoints[:1], guess.times[:1])
            verdicts.append(check_ends(self.robot, ends, self.sdf, self.config.validation))
        valid = [guess for guess, verdict in zip(guesses, verdicts, strict=True) if verdict.success]
        return (valid, None) if valid else (guesses[:1], verdicts[0])

    def settled(self, q: Float[Tensor, "b n dof"], metric: Metric) -> Float[Tensor, "b n dof"]:
        """Trajectories brought back to the constraints and the joint limits, smoothly."""
        if self.constraints:
            q = torch.stack([project_to_constraints(one, metric, self.constraints) for one in q])
        inner = project_to_limits(q[:, metric.interior], self.robot.joint_limits, metric)
        return torch.cat([q[:, :1], inner, q[:, 1 + inner.shape[1] :]], dim=1)

    def judge(self, trajectory: Trajectory) -> Validation:
        """The dense check, and the constraints."""
        verdict = check(self.robot, trajectory, self.sdf, self.config.validation)
        excess = violation(self.constraints, trajectory.waypoints)
        if not verdict.success or excess <= self.config.constraint_tolerance:
            return verdict
        message = f"a constraint is violated by {excess:.2g} (tolerance {self.config.constraint_tolerance:g})"
        return replace(verdict, status=Status.CONSTRAINT, message=message)

    def best_of(
        self, descent: Descent, guesses: list[Trajectory], best: _Best | None, late: _Deadline
    ) -> _Best:
        """The first valid one of a descent's trajectories, else the best of all that were judged."""
        for i in descent.order():
            candidate = Trajectory(descent.q[i], guesses[i].times)
            judged = _Best(candidate, self.judge(candidate))
            if best is None or judged.rank > best.rank or (judged.verdict.success and best.verdict.success):
                best = judged
            if judged.verdict.success or late():
                break
        assert best is not None
        return best


@dataclass
class _Deadline:
    """Whether another step would end too late; a step is taken to last as long as the longest one so far."""

    started: float
    seconds: float | None
    reserve: float
    asked: float = math.inf
    longest: float = 0.0

    def begin(self) -> None:
        """What was done until now was no step."""
        self.asked = math.inf

    def __call__(self) -> bool:
        now = time.perf_counter()
        self.longest, self.asked = max(self.longest, now - self.asked), now
        if self.seconds is None:
            return False
        return now - self.started + self.longest + self.reserve >= self.seconds


def _without_gradient(verdict: Validation) -> Validation:
    message = (
        f"{verdict.message}; the field's gradient is NaN or infinite on the way, so nothing can be optimised"
    )
    return replace(verdict, status=Status.INVALID_FIELD, message=message)


def _result(trajectory: Trajectory, verdict: Validation, history: list[float], started: float) -> PlanResult:
    seconds = time.perf_counter() - started
    logger.debug("CHOMP: %s after %d iterations, %s", verdict.status.value, len(history), verdict.message)
    return PlanResult(
        trajectory, verdict.status, verdict.message, verdict.clearance, tuple(history), len(history), seconds
    )
