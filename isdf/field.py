"""Distance fields: an immutable snapshot of the network, and the same baked onto a grid."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .display import ShownField
from .errors import ConfigError, IsdfError
from .network import SDFNetwork

# Points a block: small enough for its activations to stay in the processor's cache.
QUERY_BLOCK = 4096


class _AnalyticGradient(torch.autograd.Function):
    """Autograd through a field by its own gradient, without a graph through the network."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, field: Any) -> Tensor:  # type: ignore[override]
        distance, gradient = field.distance_and_gradient(points)
        ctx.save_for_backward(gradient)
        return distance

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        (gradient,) = ctx.saved_tensors
        return grad[..., None] * gradient, None


def check_points(points: Tensor) -> None:
    """Refuse anything but (..., 3) floating-point points."""
    if points.ndim < 1 or points.shape[-1] != 3 or not points.dtype.is_floating_point:
        raise IsdfError(
            f"points must be floating point of shape (..., 3), metres in the world frame; got {points.dtype} of "
            f"shape {tuple(points.shape)}"
        )


class AnalyticField(ShownField):
    """Base of the fields that know their own gradient: what follows from `distance_and_gradient`.

    Attributes:
        bounds: (2, 3) lower and upper corner of what was observed [m].
    """

    bounds: Float[Tensor, "2 3"]

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distance [m] at world points [m], positive outside; differentiable by autograd."""
        check_points(points)
        if torch.is_grad_enabled() and points.requires_grad:
            return _AnalyticGradient.apply(points, self)
        return self._distance(points)

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] and its spatial gradient at world points [m]; no autograd graph."""
        raise NotImplementedError

    def bake(
        self, spacing: float = 0.05, bounds: Float[Tensor, "2 3"] | None = None, padding: float = 0.2
    ) -> GridField:
        """Sample the field on a regular grid, whose queries cost the same everywhere.

        Args:
            spacing: distance of grid points [m].
            bounds: (2, 3) region [m]; by default what was observed.
            padding: added on every side [m].
        """
        return bake(self, self.bounds if bounds is None else bounds, spacing, padding)

    def _distance(self, points: Tensor) -> Tensor:
        """Distances alone, without a graph; fields that have them cheaper say so."""
        return self.distance_and_gradient(points)[0]


class NeuralField(AnalyticField):
    """An immutable snapshot of a map: it does not change while mapping goes on.

    Args:
        network: copied.
        bounds: (2, 3) lower and upper corner of what was observed [m].
    """

    def __init__(self, network: SDFNetwork, bounds: Float[Tensor, "2 3"]) -> None:
        self._network = copy.deepcopy(network).requires_grad_(False)
        self.bounds = bounds.clone()

    def _distance(self, points: Tensor) -> Tensor:
        flat = self._to_network(points)
        with torch.no_grad():
            out = torch.cat([self._network(block) for block in flat.split(QUERY_BLOCK)] or [flat[:, 0]])
        return out.to(points).view(points.shape[:-1])

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] and its spatial gradient at world points [m]; no autograd graph."""
        check_points(points)
        flat = self._to_network(points)
        with torch.no_grad():
            parts = [self._network.distance_and_gradient(block) for block in flat.split(QUERY_BLOCK)]
        distance = torch.cat([p[0] for p in parts] or [flat[:, 0]])
        gradient = torch.cat([p[1] for p in parts] or [flat])
        return distance.to(points).view(points.shape[:-1]), gradient.to(points).view(points.shape)

    def _to_network(self, points: Tensor) -> Tensor:
        return points.detach().reshape(-1, 3).to(self._network.origin)


class GridField(AnalyticField):
    """Trilinear interpolation of distances on a regular grid.

    Outside the grid the value is that of the closest point on its boundary and the gradient across it is zero.

    Args:
        values: (nx, ny, nz) signed distances [m].
        origin: (3,) world position [m] of the first value.
        spacing: distance of grid points [m].
    """

    def __init__(self, values: Float[Tensor, "nx ny nz"], origin: Float[Tensor, "3"], spacing: float) -> None:
        if min(values.shape) < 2 or not spacing > 0:
            raise ConfigError(
                f"a grid needs at least 2 points an axis and a positive spacing, "
                f"got {tuple(values.shape)} and {spacing}"
            )
        self.values, self.origin, self.spacing = values.contiguous(), origin.clone(), float(spacing)
        self._volume = self.values.permute(2, 1, 0).contiguous()[None, None]
        self.bounds = torch.stack(
            [self.origin, self.origin + (torch.tensor(values.shape, device=origin.device) - 1) * self.spacing]
        )

    def _distance(self, points: Tensor) -> Tensor:
        with torch.no_grad():
            flat = points.detach().reshape(-1, 3).to(self.values)
            # grid_sample wants (z, y, x) volumes and x, y, z in [-1, 1]; it clamps as we do, at half our cost.
            place = 2 * (flat - self.bounds[0].to(flat)) / (self.bounds[1] - self.bounds[0]).to(flat) - 1
            sampled = torch.nn.functional.grid_sample(
                self._volume, place[None, None, None], padding_mode="border", align_corners=True
            )
            return sampled.view(-1).to(points).view(points.shape[:-1])

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] and the exact gradient of the interpolant; no autograd graph."""
        check_points(points)
        with torch.no_grad():
            corners, t, inside = self._cells(points)
            distance, faces = _trilinear(corners, t)
            gradient = _trilinear_gradient(corners, t, faces) / self.spacing
            gradient = torch.where(inside, gradient, torch.zeros_like(gradient))
        return distance.to(points).view(points.shape[:-1]), gradient.to(points).view(points.shape)

    def _cells(self, points: Tensor) -> tuple[list, Tensor, Tensor]:
        """The 8 corner values c[i][j][k] of each point's cell, its place t in the cell, and what is inside."""
        flat = points.detach().reshape(-1, 3).to(self.values)
        sizes = torch.tensor(self.values.shape, device=flat.device)
        unclamped = (flat - self.origin.to(flat)) / self.spacing
        cell = torch.minimum(unclamped.clamp(min=0), (sizes - 1).to(flat))
        base = torch.minimum(cell.long(), sizes - 2)
        strides = torch.tensor(self.values.stride(), device=flat.device)
        corner = (base * strides).sum(dim=-1)
        v = self.values.view(-1)
        sx, sy, sz = strides.tolist()
        c = [[[v[corner + i * sx + j * sy + k * sz] for k in (0, 1)] for j in (0, 1)] for i in (0, 1)]
        return c, cell - base, unclamped == cell


class ConfidentGridField(GridField):
    """A `GridField` that knows how sure the field was that it was sampled from.

    Args:
        values: (nx, ny, nz) signed distances [m].
        origin: (3,) world position [m] of the first value.
        spacing: distance of grid points [m].
        confidence: (nx, ny, nz) in [0, 1].
    """

    def __init__(
        self,
        values: Float[Tensor, "nx ny nz"],
        origin: Float[Tensor, "3"],
        spacing: float,
        confidence: Float[Tensor, "nx ny nz"],
    ) -> None:
        super().__init__(values, origin, spacing)
        self._confidence = GridField(confidence, origin, spacing)

    def confidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Interpolated confidence in [0, 1] at world points [m], 0 outside the grid."""
        check_points(points)
        inside = ((points >= self.bounds[0].to(points)) & (points <= self.bounds[1].to(points))).all(dim=-1)
        return self._confidence._distance(points) * inside


def _trilinear(c: list, t: Tensor) -> tuple[Tensor, tuple[list, list]]:
    """Value of trilinear interpolation at t in [0, 1]^3, and the intermediate edges and faces."""
    x, y, z = t.unbind(dim=-1)
    edge = [[torch.lerp(c[i][j][0], c[i][j][1], z) for j in (0, 1)] for i in (0, 1)]
    face = [torch.lerp(edge[i][0], edge[i][1], y) for i in (0, 1)]
    return torch.lerp(face[0], face[1], x), (edge, face)


def _trilinear_gradient(c: list, t: Tensor, faces: tuple[list, list]) -> Tensor:
    """Gradient of that value with respect to t."""
    x, y, _ = t.unbind(dim=-1)
    edge, face = faces
    dy = [edge[i][1] - edge[i][0] for i in (0, 1)]
    dz = [torch.lerp(c[i][0][1] - c[i][0][0], c[i][1][1] - c[i][1][0], y) for i in (0, 1)]
    return torch.stack([face[1] - face[0], torch.lerp(dy[0], dy[1], x), torch.lerp(dz[0], dz[1], x)], dim=-1)


def grid_points(bounds: Float[Tensor, "2 3"], spacing: float) -> Float[Tensor, "nx ny nz 3"]:
    """World positions [m] of a regular grid that starts at the lower corner and reaches the upper."""
    if not spacing > 0 or not bool(torch.isfinite(bounds).all()) or not bool((bounds[1] > bounds[0]).all()):
        raise ConfigError(
            f"a grid needs spacing > 0 and finite bounds with lower < upper, got spacing {spacing} and bounds "
            f"{bounds.tolist()}"
        )
    counts = torch.ceil((bounds[1] - bounds[0]) / spacing).long() + 1
    axes = [bounds[0, i] + spacing * torch.arange(int(n), device=bounds.device) for i, n in enumerate(counts)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def bake(field: Any, bounds: Float[Tensor, "2 3"], spacing: float, padding: float = 0.0) -> GridField:
    """Sample any distance field on a regular grid over `bounds` (2, 3) [m] grown by `padding` [m].

    Where the field offers `confidence`, so does the grid.
    """
    bounds = bounds.float() + padding * torch.tensor([[-1.0], [1.0]], device=bounds.device)
    points = grid_points(bounds, spacing)
    distance = field.distance(points)
    if hasattr(field, "confidence"):
        return ConfidentGridField(distance, bounds[0], spacing, field.confidence(points))
    return GridField(distance, bounds[0], spacing)


def query(field: Any, points: np.ndarray) -> dict[str, np.ndarray]:
    """Distances and gradients for numpy points: what a caller without torch wants.

    Args:
        field: any distance field.
        points: (n, 3) world points [m].

    Returns:
        `distance` (n,) [m], `gradient` (n, 3), and `confidence` (n,) where the field has one.
    """
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3 or not np.issubdtype(array.dtype, np.number):
        raise IsdfError(
            f"points must be a numeric (n, 3) array of world metres, got {array.dtype} {array.shape}"
        )
    tensor = torch.from_numpy(array.astype(np.float32))
    distance, gradient = field.distance_and_gradient(tensor)
    out = {"distance": distance.numpy(), "gradient": gradient.numpy()}
    if hasattr(field, "confidence"):
        out["confidence"] = field.confidence(tensor).numpy()
    return out
