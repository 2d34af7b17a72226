"""Pure functions of the CHOMP cost: c(d), the obstacle functional by arc length, self-collision."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

if TYPE_CHECKING:
    from planning.compiled.self_collision import PairGroups


def hinge_cost(
    distance: Float[Tensor, "*batch"], eps: float
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Cost c(d) of a clearance d [m] and its derivative (CHOMP, equation 21).

    c = eps/2 - d inside (d < 0), (d - eps)^2 / (2 eps) up to eps, 0 beyond. NaN stays NaN.
    """
    shortfall = (eps - distance).clamp_min(0.0)
    inside = distance < 0
    cost = torch.where(inside, 0.5 * eps - distance, shortfall.square() / (2 * eps))
    slope = torch.where(inside, -torch.ones_like(distance), -shortfall / eps)
    return cost, slope


def arc_length_cost(
    points: Float[Tensor, "*batch n s 3"],
    cost: Float[Tensor, "*batch n s"],
    cost_gradient: Float[Tensor, "*batch n s 3"],
    guard: float = 1e-3,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch n s 3"]]:
    """Obstacle functional of the paths of s spheres and its exact gradient (CHOMP, equations 18 and 23).

    U = sum over segments of (c_i + c_{i+1}) / 2 * l_i, the trapezoid rule of the integral of c |x'| dt, with
    l = sqrt(|dx|^2 + guard^2), so that a sphere at rest keeps a cost and no division by zero occurs. The
    gradient is that of this sum. It needs no explicit curvature: as the waypoints grow denser it tends to
    |x'| [(I - x' x'^T) grad c - c kappa], of which it is the form before integration by parts.

    Args:
        points: positions x of the spheres at n waypoints [m].
        cost: c there [m].
        cost_gradient: grad c there.
        guard: [m].

    Returns:
        U summed over spheres [m^2], and dU/dx of the shape of the points.
    """
    steps = points.diff(dim=-3)
    lengths = (steps.square().sum(-1) + guard**2).sqrt()
    means = 0.5 * (cost[..., :-1, :] + cost[..., 1:, :])
    pull = (means / lengths).unsqueeze(-1) * steps  # mean cost times the unit tangent
    half = 0.5 * lengths.unsqueeze(-1)
    gradient = torch.zeros_like(points)
    gradient[..., :-1, :, :] += half * cost_gradient[..., :-1, :, :] - pull
    gradient[..., 1:, :, :] += half * cost_gradient[..., 1:, :, :] + pull
    return (means * lengths).sum((-2, -1)), gradient


def self_collision_cost(
    centres: Float[Tensor, "*batch n s 3"],
    radii: Float[Tensor, " s"],
    groups: PairGroups,
    eps: float,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch n s 3"], Float[Tensor, "*batch n"]]:
    """Sum over waypoints and pairs of c(gap between two spheres), averaged over the waypoints.

    Args:
        centres: of the spheres at n waypoints [m].
        radii: of the spheres [m].
        groups: the pairs that must not touch, from `planning.compiled.self_collision.grouped`.
        eps: gap at which the cost starts [m].

    Returns:
        The cost [m], its gradient with respect to the centres, and the smallest gap [m] at each waypoint.
    """
    from planning.compiled.self_collision import pair_costs

    n, s = centres.shape[-3:-1]
    flat = centres.detach().reshape(-1, s, 3).double().numpy()
    cost, gradient, gap = pair_costs(flat, radii.double().numpy(), groups, eps)
    batch = centres.shape[:-2]
    return (
        torch.from_numpy(cost).to(centres).view(batch).mean(-1),
        torch.from_numpy(gradient).to(centres).view_as(centres) / n,
        torch.from_numpy(gap).to(centres).view(batch),
    )
