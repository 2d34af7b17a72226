"""Covariant gradient descent of a batch of trajectories, each with its own step size and its own end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from planning.numbers import refuse_nan
from planning.objective import Evaluation, Objective


@dataclass(frozen=True)
class DescentConfig:
    """How the descent steps and when it stops.

    Args:
        step: first step size 1 / eta of the update; it grows by a fifth after each decrease and halves after
            each increase of the objective (which is undone).
        max_update: no joint of any waypoint moves further than this in one iteration [rad | m].
        tolerance: the cost is on a plateau when it fell by less than this fraction over `patience` iterations.
        patience: see tolerance.
        polish: most iterations after the trajectory is free, for smoothness.
    """

    step: float = 1.0
    max_update: float = 0.1
    tolerance: float = 1e-2
    patience: int = 10
    polish: int = 50

    def __post_init__(self) -> None:
        refuse_nan(self)


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a descent ended: the best waypoints of each trajectory, free before cheap."""

    q: Float[Tensor, "b n dof"]
    total: Float[Tensor, " b"]
    free: Bool[Tensor, " b"]
    blind: Bool[Tensor, " b"]
    """Whether the objective or its gradient was not finite where the descent began, so that nothing could be done."""

    def order(self) -> list[int]:
        """The trajectories, the most promising first."""
        return sorted(range(len(self.q)), key=lambda i: (not self.free[i], float(self.total[i])))


def descend(
    objective: Objective,
    q: Float[Tensor, "b n dof"],
    config: DescentConfig,
    settle: Callable[[Tensor], Tensor],
    history: list[float],
    max_iterations: int,
    late: Callable[[], bool],
) -> Descent:
    """Follow q - step A^-1 grad U (CHOMP, equation 8) until every trajectory is on a plateau.

    Args:
        objective: what falls.
        q: where to start.
        config: steps and stopping.
        settle: brings trajectories back to limits and constraints after an update.
        history: gets the least total of the batch at every iteration appended.
        max_iterations: of all entries in the history.
        late: whether time is up.
    """
    metric = objective.metric
    now = objective(q)
    best_q, best = q, now
    step = torch.full((len(q), 1, 1), config.step, dtype=q.dtype)
    polished = torch.zeros(len(q), dtype=torch.long)
    active = _finite(now)
    blind = ~active
    totals: list[Tensor] = []
    while len(history) < max_iterations and active.any() and not late():
        history.append(float(now.total.nan_to_num(math.inf).min()))
        totals.append(now.total)
        update = step * metric.solve(now.gradient.where(active[:, None, None], 0.0))
        update *= (config.max_update / update.abs().amax(dim=1, keepdim=True).clamp_min(1e-12)).clamp_max(1.0)
        candidate = q.clone()
        candidate[:, metric.interior] -= update
        candidate = settle(candidate)
        then = objective(candidate)
        lower = (then.total < now.total) & active & _finite(then)
        q = torch.where(lower[:, None, None], candidate, q)
        now = then.where(lower, now)
        step = torch.where(lower[:, None, None], 1.2 * step, 0.5 * step)
        better = lower & (now.free | ~best.free)
        best_q, best = torch.where(better[:, None, None], q, best_q), now.where(better, best)
        polished += best.free
        active &= (polished < config.polish) & ~_plateau(totals, config)
    return Descent(best_q, best.total, best.free, blind)


def _finite(at: Evaluation) -> Bool[Tensor, " b"]:
    return torch.isfinite(at.total) & torch.isfinite(at.gradient).all(dim=-1).all(dim=-1)


def _plateau(totals: list[Tensor], config: DescentConfig) -> Bool[Tensor, " b"]:
    if len(totals) <= config.patience:
        return torch.zeros_like(totals[-1], dtype=torch.bool)
    before, now = totals[-1 - config.patience], totals[-1]
    return before - now <= config.tolerance * before.abs()
