"""Restarts by Hamiltonian Monte Carlo: leave a local minimum with smooth momentum (CHOMP, section 4)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from planning.metric import Metric
from planning.objective import Objective


def shaken(
    objective: Objective,
    q: Float[Tensor, "b n dof"],
    temperature: float,
    generator: torch.Generator,
    settle: Callable[[Tensor], Tensor],
    steps: int = 8,
    stride: float = 0.3,
) -> Float[Tensor, "b n dof"]:
    """Where trajectories are after a few leapfrog steps from a random smooth momentum.

    The momentum is drawn from N(0, T A^-1); kinetic energy is measured in the metric, so force is A^-1 grad U. No step
    is rejected: the descent that follows decides what becomes of it, and annealing lowers T.

    Args:
        objective: the potential energy U.
        q: where to start.
        temperature: T; its root is the size of the momentum [rad | m].
        generator: of the momentum.
        settle: brings trajectories back to limits and constraints after each step.
        steps: leapfrog steps.
        stride: of a step.
    """
    metric: Metric = objective.metric
    interior = q[..., metric.interior, :]
    noise = torch.randn(interior.shape, generator=generator, dtype=torch.float64).to(q)
    momentum = temperature**0.5 * metric.smooth_noise(noise)
    pull = metric.solve(objective(q).gradient)
    for _ in range(steps):
        momentum = momentum - 0.5 * stride * pull
        q = q.clone()
        q[..., metric.interior, :] += (stride * momentum).clamp(-0.5, 0.5)
        q = settle(q)
        pull = metric.solve(objective(q).gradient)
        momentum = momentum - 0.5 * stride * pull
    return q
