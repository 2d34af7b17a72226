"""Small analytic distance fields for tests; numbers in metres."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


class AutogradField:
    """Base: the gradient of `distance` by autograd."""

    def distance(self, points: Tensor) -> Tensor:
        raise NotImplementedError

    def distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            distance = self.distance(points)
            (gradient,) = torch.autograd.grad(distance.sum(), points)
        return distance.detach(), gradient


@dataclass
class Sphere(AutogradField):
    centre: tuple[float, float, float]
    radius: float

    def distance(self, points: Tensor) -> Tensor:
        offset = points - torch.tensor(self.centre).to(points)
        return (offset.square().sum(-1) + 1e-18).sqrt() - self.radius


@dataclass
class Cylinder(AutogradField):
    """An endless vertical cylinder."""

    centre: tuple[float, float]
    radius: float

    def distance(self, points: Tensor) -> Tensor:
        offset = points[..., :2] - torch.tensor(self.centre).to(points)
        return (offset.square().sum(-1) + 1e-18).sqrt() - self.radius


@dataclass
class Box(AutogradField):
    centre: tuple[float, float, float]
    half_size: tuple[float, float, float]

    def distance(self, points: Tensor) -> Tensor:
        beyond = (points - torch.tensor(self.centre).to(points)).abs() - torch.tensor(self.half_size).to(
            points
        )
        outside = (beyond.clamp_min(0).square().sum(-1) + 1e-18).sqrt()
        return outside + beyond.amax(-1).clamp_max(0)


@dataclass
class Room(AutogradField):
    """The inside of a box: positive within the walls."""

    box: Box

    def distance(self, points: Tensor) -> Tensor:
        return -self.box.distance(points)


@dataclass
class HalfSpace(AutogradField):
    """Solid below offset along a unit normal; the floor z = 0 by default."""

    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    offset: float = 0.0

    def distance(self, points: Tensor) -> Tensor:
        return points @ torch.tensor(self.normal).to(points) - self.offset


class Union(AutogradField):
    def __init__(self, *parts: AutogradField) -> None:
        self.parts = parts

    def distance(self, points: Tensor) -> Tensor:
        return torch.stack([part.distance(points) for part in self.parts]).amin(0)


class Grid(AutogradField):
    """Trilinear interpolation of a field sampled on a grid: stands for a voxel map."""

    def __init__(self, field: AutogradField, low: tuple, high: tuple, voxel: float) -> None:
        self.low, self.high = torch.tensor(low), torch.tensor(high)
        shape = ((self.high - self.low) / voxel).round().long() + 1
        axes = [torch.linspace(a, b, int(n)) for a, b, n in zip(low, high, shape, strict=True)]
        values = field.distance(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1))
        self.values = values.permute(2, 1, 0)[None, None]

    def distance(self, points: Tensor) -> Tensor:
        low, high = self.low.to(points), self.high.to(points)
        unit = (2 * (points - low) / (high - low) - 1).reshape(1, -1, 1, 1, 3)
        sampled = torch.nn.functional.grid_sample(
            self.values.to(points), unit, align_corners=True, padding_mode="border"
        )
        return sampled.reshape(points.shape[:-1])


class Network(AutogradField):
    """A small multilayer perceptron fitted to another field: stands for a neural map."""

    def __init__(self, field: AutogradField, low: tuple, high: tuple, steps: int = 400) -> None:
        generator = torch.Generator().manual_seed(0)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.net = torch.nn.Sequential(
                torch.nn.Linear(3, 64), torch.nn.Softplus(20), torch.nn.Linear(64, 64), torch.nn.Softplus(20),
                torch.nn.Linear(64, 1),
            )  # fmt: skip
        optimiser = torch.optim.Adam(self.net.parameters(), lr=5e-3)
        low_, high_ = torch.tensor(low), torch.tensor(high)
        for _ in range(steps):
            points = low_ + (high_ - low_) * torch.rand(2000, 3, generator=generator)
            loss = (self.net(points)[:, 0] - field.distance(points)).abs().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        self.net.requires_grad_(False)

    def distance(self, points: Tensor) -> Tensor:
        return self.net(points)[..., 0]


@dataclass
class Confident(AutogradField):
    """A field that was only seen where x is below a limit."""

    field: AutogradField
    seen_below: float

    def distance(self, points: Tensor) -> Tensor:
        return self.field.distance(points)

    def confidence(self, points: Tensor) -> Tensor:
        return (points[..., 0] < self.seen_below).to(points)


@dataclass
class NanBeyond(AutogradField):
    """A field that is NaN where x exceeds a limit."""

    field: AutogradField
    limit: float

    def distance(self, points: Tensor) -> Tensor:
        return torch.where(points[..., 0] > self.limit, torch.nan, self.field.distance(points))


@dataclass
class HingeCost:
    """The paper's cost over a field, as a CostField."""

    field: AutogradField
    eps: float

    def cost_and_gradient(self, points: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            d = self.field.distance(points) - radii
            near = (d - self.eps) ** 2 / (2 * self.eps)
            cost = torch.where(d < 0, self.eps / 2 - d, torch.where(d < self.eps, near, torch.zeros_like(d)))
            (gradient,) = torch.autograd.grad(cost.sum(), points)
        return cost.detach(), gradient


def walls_round(x: float) -> Union:
    """Four walls that close in the square of half size 0.4 m round (x, 0)."""
    sides = [(0.5, 0.0, 0.1, 0.6), (-0.5, 0.0, 0.1, 0.6), (0.0, 0.5, 0.6, 0.1), (0.0, -0.5, 0.6, 0.1)]
    return Union(*(Box((x + dx, dy, 0.3), (hx, hy, 1.0)) for dx, dy, hx, hy in sides))
