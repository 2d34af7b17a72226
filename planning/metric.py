"""The metric A of covariant gradient descent: which trajectories are near each other (CHOMP, section 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from planning.errors import ConfigError
from planning.numbers import refuse_nan


@dataclass(frozen=True)
class MetricConfig:
    """Weights of the squared derivatives that make up the smoothness and the metric.

    Time runs from 0 to 1 along the trajectory, so the weights do not depend on the number of waypoints.

    Args:
        velocity: weight of the squared velocity. On its own it gives the shortest way out of an obstacle.
        acceleration: weight of the squared acceleration; it rounds corners. The default makes bends of about
            a seventh of the trajectory cost as much as their length does.
        jerk: weight of the squared jerk.
        ridge: relative to the largest diagonal entry, added to the diagonal of A for the update only.
    """

    velocity: float = 1.0
    acceleration: float = 0.02
    jerk: float = 0.0
    ridge: float = 1e-6

    def __post_init__(self) -> None:
        refuse_nan(self)
        weights = (self.velocity, self.acceleration, self.jerk)
        if min(weights) < 0 or max(weights) == 0 or self.ridge < 0:
            raise ConfigError(
                f"MetricConfig: weights must not be negative and one must be positive, got {self}."
            )


class Metric:
    """Smoothness F(q) = 1/2 sum_d w_d |K_d q|^2 of n waypoints, and its metric A.

    A = sum_d w_d K_d^T K_d + ridge. K_d are finite differences of order d; before the first and after the
    last waypoint the robot rests. The first and last waypoint are fixed, so A is over the n - 2 interior
    ones. The whole is scaled so that a unit push on the waypoint that gives way most moves it by one unit,
    whichever derivatives are weighted (CHOMP, equations 10-17). With `free_goal` the last waypoint counts
    as an interior one, for goals that are constraints. Matrices are kept in float64 (A is ill-conditioned),
    arguments keep their type.
    """

    def __init__(
        self, num_waypoints: int, config: MetricConfig | None = None, free_goal: bool = False
    ) -> None:
        if num_waypoints < 3:
            raise ConfigError(
                f"Metric: at least 3 waypoints are needed, got {num_waypoints}; resample first."
            )
        config = config or MetricConfig()
        step = 1.0 / (num_waypoints - 1)
        full = torch.zeros(num_waypoints, num_waypoints, dtype=torch.float64)
        for order, weight in enumerate((config.velocity, config.acceleration, config.jerk), start=1):
            if weight > 0:
                difference = _difference_matrix(num_waypoints, order) / step**order
                full += weight * step * difference.T @ difference
        self.free_goal = free_goal
        self.interior = slice(1, num_waypoints if free_goal else num_waypoints - 1)
        interior = full[self.interior, self.interior]
        ridge = config.ridge * interior.diagonal().max() * torch.eye(len(interior), dtype=torch.float64)
        inverse = torch.linalg.inv(interior + ridge)
        response = inverse.diagonal().max()  # makes the largest entry of A^-1 one
        self._full = full * response
        self.inverse = inverse / response

    def smoothness(
        self, q: Float[Tensor, "*batch n dof"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch n_interior dof"]]:
        """F(q) and its gradient with respect to the interior waypoints."""
        product = self._full @ q.double()
        return 0.5 * (product * q).sum((-2, -1)), product[..., self.interior, :].to(q)

    def solve(self, gradient: Float[Tensor, "*batch n_interior k"]) -> Float[Tensor, "*batch n_interior k"]:
        """A^-1 times a gradient over the interior waypoints."""
        return (self.inverse @ gradient.double()).to(gradient)

    def smooth_noise(
        self, noise: Float[Tensor, "*batch n_interior k"]
    ) -> Float[Tensor, "*batch n_interior k"]:
        """Standard normal numbers turned into a sample of N(0, A^-1): a smooth random motion."""
        return (torch.linalg.cholesky(self.inverse) @ noise.double()).to(noise)


def _difference_matrix(num_waypoints: int, order: int) -> Float[Tensor, "rows n"]:
    """Finite differences of one order, the ends repeated outwards (at rest before and after)."""
    padding = order - 1
    padded = torch.eye(num_waypoints, dtype=torch.float64)
    padded = torch.cat([padded[:1].expand(padding, -1), padded, padded[-1:].expand(padding, -1)])
    for _ in range(order):
        padded = padded.diff(dim=0)
    assert math.isclose(
        float(padded.sum(dim=1).abs().max()), 0.0, abs_tol=1e-9
    )  # a constant has no derivative
    return padded
