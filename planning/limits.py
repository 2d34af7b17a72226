"""Joint limits kept by smooth projection."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from planning.metric import Metric


def project_to_limits(
    q: Float[Tensor, "*batch n_interior dof"],
    limits: Float[Tensor, "dof 2"],
    metric: Metric,
    iterations: int = 20,
    tolerance: float = 1e-6,
) -> Float[Tensor, "*batch n_interior dof"]:
    """Bring interior waypoints within the limits by smooth corrections A^-1 v (CHOMP, section 3.5).

    v is the violation; each round scales the correction of a joint so that its worst waypoint lands on its
    limit. What is left after the last round is clamped.
    """
    low, high = limits.to(q).unbind(dim=1)
    for _ in range(iterations):
        violation = (low - q).clamp_min(0) - (q - high).clamp_min(0)
        size, worst = violation.abs().max(dim=-2, keepdim=True)
        if size.max() <= tolerance:
            break
        correction = metric.solve(violation)
        at_worst, wanted = correction.gather(-2, worst), violation.gather(-2, worst)
        q = q + correction * (wanted / at_worst).where(size > 0, 0.0)
    return q.clamp(low, high)
