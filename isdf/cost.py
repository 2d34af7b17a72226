"""The CHOMP collision cost as a function of world points (paper section 5.3; Zucker et al., IJRR 2013)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import ConfigError


class CostField:
    """c(f(x) - r): what a trajectory optimiser descends.

    With s the distance from a sphere's surface to the closest obstacle, c(s) = -s + eps/2 inside obstacles,
    (s - eps)^2 / (2 eps) within eps of them, and 0 beyond; c and its slope are continuous.

    Args:
        field: any distance field (`distance` and `distance_and_gradient`).
        eps: reach of the cost outside obstacles [m].
    """

    def __init__(self, field: Any, eps: float) -> None:
        if not eps > 0:
            raise ConfigError(f"eps must be a positive distance in metres, got {eps}")
        self.field, self.eps = field, float(eps)

    def cost(
        self, points: Float[Tensor, "*batch 3"], radii: Float[Tensor, "..."] | float = 0.0
    ) -> Float[Tensor, "*batch"]:
        """Cost [m] of spheres of the given radii [m] at world points [m]; differentiable by autograd."""
        return collision_cost(self.field.distance(points) - radii, self.eps)[0]

    def cost_and_gradient(
        self, points: Float[Tensor, "*batch 3"], radii: Float[Tensor, "..."] | float = 0.0
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Cost [m] and its gradient with respect to the points in one call, without a graph."""
        distance, gradient = self.field.distance_and_gradient(points)
        cost, slope = collision_cost(distance - radii, self.eps)
        return cost, slope[..., None] * gradient


def collision_cost(
    distance: Float[Tensor, "*batch"], eps: float
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """c(s) and dc/ds for signed distances s [m]."""
    slope = ((distance - eps) / eps).clamp(-1.0, 0.0)
    within = 0.5 * eps * slope * slope
    return torch.where(distance < 0, 0.5 * eps - distance, within), slope
