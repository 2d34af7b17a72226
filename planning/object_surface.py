"""What stands where somebody points: the part of a field's zero level set that belongs to one object on its support."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from planning.errors import ConfigError, FieldError
from planning.protocols import ConfidentField, DistanceField
from planning.threads import one_thread

MOST = 2500
"""Points on an object; finding out which hang together takes time that grows with their square."""
LAYER, CELL = 0.008, 0.02
"""The size of level faces is measured in layers of this height and cells of this width [m]."""


@dataclass(frozen=True)
class SurfaceConfig:
    """How an object is told from what it stands on.

    Args:
        radius: nothing farther than this from the point belongs to the object [m].
        around: the support is looked for up to this far from the point [m], where it is larger than the object's top.
        samples: points that are moved onto the zero level set.
        accuracy: points that stay farther than this from it are dropped [m].
        above: what is lower than this over the support is taken for the support [m].
        gap: parts of an object lie nearer than this to each other [m].
        confidence: where the field knows how sure it is, surfaces that it only guesses, below this, are left out.
    """

    radius: float = 0.2
    around: float = 0.35
    samples: int = 8000
    accuracy: float = 0.002
    above: float = 0.009
    gap: float = 0.015
    confidence: float = 0.75

    def __post_init__(self) -> None:
        if not min(self.radius, self.around, self.samples, self.accuracy, self.above, self.gap) > 0:
            raise ConfigError(f"SurfaceConfig: all values must be positive, got {self}.")


@dataclass(frozen=True, eq=False)
class ObjectSurface:
    """Points on an object's surface as a map knows it; the side that nobody saw may be missing.

    Args:
        points: (n, 3) [m].
        normals: (n, 3) unit, outwards.
        support: height of what it stands on [m].
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    support: float


@one_thread
def object_surface(
    field: DistanceField, point: Float[Tensor, "3"], config: SurfaceConfig | None = None, seed: int = 0
) -> ObjectSurface | None:
    """Find the object at a point.

    Args:
        field: the map; its zero level set is all that is looked at.
        point: on the object or within a centimetre or two of it [m].
        config: see `SurfaceConfig`.
        seed: of the samples.

    Returns:
        None where nothing stands out from a support.

    Raises:
        FieldError: the point is not finite.
    """
    config = config or SurfaceConfig()
    if not torch.isfinite(point).all():
        raise FieldError(f"object_surface: the point must be finite, got {point.tolist()}.")
    support = support_height(*zero_level(field, point, config.around, config, seed), float(point[2]), config)
    points, normals = zero_level(field, point, config.radius, config, seed)
    standing = (points[:, 2] > support + config.above).nonzero()[:MOST, 0]
    points, normals = points[standing], normals[standing]
    if len(points) == 0:
        return None
    part = _joined_to(point, points, config.gap)
    return ObjectSurface(points[part], normals[part], support)


def zero_level(
    field: DistanceField, point: Float[Tensor, "3"], radius: float, config: SurfaceConfig, seed: int = 0
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Points of the zero level set within a radius [m] and the field's unit gradients there.

    Random points go down the distance by Newton steps; those nearer to the middle are drawn more often.
    """
    generator = torch.Generator().manual_seed(seed)
    ways = torch.nn.functional.normalize(torch.randn(config.samples, 3, generator=generator), dim=1)
    reach = radius * torch.rand(config.samples, 1, generator=generator).sqrt()
    points = point + reach * ways
    for _ in range(6):
        distance, gradient = field.distance_and_gradient(points)
        slope = gradient.square().sum(dim=1, keepdim=True).clamp_min(0.25)
        points = points - (distance[:, None] * gradient / slope).clamp(-0.05, 0.05)
    distance, gradient = field.distance_and_gradient(points)
    kept = (distance.abs() <= config.accuracy) & ((points - point).norm(dim=1) <= radius)
    if isinstance(field, ConfidentField):
        kept &= field.confidence(points) >= config.confidence
    return points[kept], torch.nn.functional.normalize(gradient[kept], dim=1)


def support_height(points: Tensor, normals: Tensor, height: float, config: SurfaceConfig) -> float:
    """Height [m] of the largest level face below `height`, -inf if there is none."""
    level = points[(normals[:, 2] > 0.9) & (points[:, 2] < height + config.above)]
    if len(level) == 0:
        return -torch.inf
    layer = (level[:, 2:] / LAYER).round()
    cells = torch.cat([layer, (level[:, :2] / CELL).round()], dim=1).unique(dim=0)
    layers, sizes = cells[:, 0].unique(return_counts=True)
    near = (level[:, 2] - LAYER * layers[sizes.argmax()]).abs() < LAYER
    return float(level[near, 2].median())


def _joined_to(point: Tensor, points: Tensor, gap: float) -> Tensor:
    """Which points hang together with the one nearest to `point`."""
    tree = cKDTree(points.numpy())
    _, labels = connected_components(tree.sparse_distance_matrix(tree, gap))
    part = torch.from_numpy(labels)
    return part == part[int((points - point).norm(dim=1).argmin())]
