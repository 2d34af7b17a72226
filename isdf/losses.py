"""The self-supervised losses (paper section 4.4), each a function of tensors of equal shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import ConfigError
from .numbers import require_finite


@dataclass(frozen=True)
class LossConfig:
    """Weights and regions. The defaults are the paper's; its text leaves the truncation t open.

    Args:
        truncation: t [m], the near-surface loss applies within it.
        surface_weight: lambda_surf.
        gradient_weight: lambda_grad.
        eikonal_weight: lambda_eik.
        eikonal_from: a [m], the eikonal loss applies from this distance on.
        free_space_beta: beta of the exponential for negative predictions in free space [1/m].
        regions_by: what t and a are compared with: "ray", the distance along the ray as in the paper's text, or
            "bound", the bound itself as in its released code: negative, so always near, behind a surface.
        noise: standard deviation [raw output] of the noise added to predicted distances, twice as much while a
            new keyframe gets its further steps; 0 in the text, 0.04 in the released code.
    """

    truncation: float = 0.30
    surface_weight: float = 5.0
    gradient_weight: float = 0.02
    eikonal_weight: float = 0.25
    eikonal_from: float = 0.10
    free_space_beta: float = 5.0
    regions_by: Literal["ray", "bound"] = "ray"
    noise: float = 0.0

    def __post_init__(self) -> None:
        require_finite(self)
        for name in (
            "truncation",
            "surface_weight",
            "gradient_weight",
            "eikonal_weight",
            "eikonal_from",
            "noise",
        ):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must be zero or more, got {getattr(self, name)}")


def free_space_loss(
    distance: Float[Tensor, "*n"], bound: Float[Tensor, "*n"], beta: float
) -> Float[Tensor, "*n"]:
    """max(0, exp(-beta f) - 1, f - b): no loss while 0 <= f <= b."""
    # Past exponent 5 the loss goes on along its tangent: a wild first guess must not overflow the exponential.
    exponent = -beta * distance
    negative = torch.exp(exponent.clamp(max=5.0)) * (1 + (exponent - 5.0).clamp(min=0)) - 1
    return torch.maximum(negative, distance - bound).clamp(min=0)


def near_surface_loss(distance: Float[Tensor, "*n"], bound: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """|f - b|."""
    return (distance - bound).abs()


def gradient_loss(gradient: Float[Tensor, "*n 3"], target: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """1 - cos(gradient, target); zero where the target has no direction."""
    length = target.norm(dim=-1)
    cosine = torch.nn.functional.cosine_similarity(gradient, target, dim=-1, eps=1e-8)
    return torch.where(length > 1e-6, 1 - cosine, torch.zeros_like(cosine))


def eikonal_loss(gradient: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """| |gradient| - 1 |."""
    return (gradient.norm(dim=-1) - 1).abs()


def total_loss(
    distance: Float[Tensor, "*n"],
    gradient: Float[Tensor, "*n 3"],
    bound: Float[Tensor, "*n"],
    target: Float[Tensor, "*n 3"],
    ray_distance: Float[Tensor, "*n"],
    config: LossConfig,
) -> Float[Tensor, "*n"]:
    """The full loss l of every sample.

    Args:
        distance: predicted signed distance [m].
        gradient: its spatial gradient.
        bound: b, the signed bound [m].
        target: unnormalised target of the gradient.
        ray_distance: D - d, measured along the ray [m].
        config: weights and regions.
    """
    region = ray_distance.abs() if config.regions_by == "ray" else bound
    near = config.surface_weight * near_surface_loss(distance, bound)
    free = free_space_loss(distance, bound, config.free_space_beta)
    loss = torch.where(region <= config.truncation, near, free)
    loss = loss + config.gradient_weight * gradient_loss(gradient, target)
    eikonal = torch.where(region >= config.eikonal_from, eikonal_loss(gradient), torch.zeros_like(loss))
    return loss + config.eikonal_weight * eikonal
