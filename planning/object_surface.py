"""What stands where somebody points: the part of a field's zero level set that belongs to one object on its support.

Where the camera was tells what of it is measured; the sides that nobody saw are guessed from the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from planning.errors import ConfigError, FieldError
from planning.hidden_sides import hidden_sides
from planning.line_of_sight import in_sight
from planning.numbers import refuse_nan
from planning.protocols import ConfidentField, DistanceField
from planning.threads import one_thread

MOST = 4000
"""Points on an object; finding out which hang together takes time that grows with their square."""
THIN = 0.004
"""Of the points in a cube of this edge [m] one is kept: near to the point that was given they lie denser."""
LAYER, CELL = 0.008, 0.02
"""The size of level faces is measured in layers of this height and cells of this width [m]."""

NEIGHBOURS, LONELY = 0.01, 2
"""Points with no more than so many others within so far [m] are left out."""


@dataclass(frozen=True)
class SurfaceConfig:
    """How an object is told from what it stands on.

    Args:
        radius: nothing farther than this from the point belongs to the object [m].
        around: the support is looked for up to this far from the point [m], where it is larger than the object's top.
        samples: points that are moved onto the zero level set.
        accuracy: points that stay farther than this from it are dropped [m].
        above: what is lower than this over the plane of the support is taken for the support [m].
        near: where nothing stands within this of the point, there is no object at it [m].
        gap: parts of an object lie nearer than this to each other [m].
        confidence: where the field knows how sure it is, surfaces that it only guesses, below this, are left out.
    """

    radius: float = 0.2
    around: float = 0.35
    samples: int = 20_000
    accuracy: float = 0.002
    above: float = 0.004
    near: float = 0.08
    gap: float = 0.015
    confidence: float = 0.75

    def __post_init__(self) -> None:
        refuse_nan(self)
        if (
            not min(self.radius, self.around, self.samples, self.accuracy, self.above, self.near, self.gap)
            > 0
        ):
            raise ConfigError(f"SurfaceConfig: all values must be positive, got {self}.")


@dataclass(frozen=True, eq=False)
class ObjectSurface:
    """Points on an object's surface as a map knows it.

    Args:
        points: (n, 3) [m].
        normals: (n, 3) unit, outwards.
        support: height of what it stands on [m].
        middle: (3,) of its volume, as far as that is known [m].
        eyes: (k, 3) where the camera was [m]; None if the whole surface is known.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    support: float
    middle: Float[Tensor, "3"]
    eyes: Float[Tensor, "k 3"] | None = None


@one_thread
def object_surface(
    field: DistanceField,
    point: Tensor,
    eyes: Float[Tensor, "k 3"] | None = None,
    config: SurfaceConfig | None = None,
    seed: int = 0,
) -> ObjectSurface | None:
    """Find the object at a point.

    Args:
        field: the map; its zero level set is all that is looked at.
        point: (3,) on the object or within a centimetre or two of it [m].
        eyes: where the camera was [m]: surfaces that it could not see are left out, and walls guessed instead of them.
            Without, the field is taken at its word.
        config: see `SurfaceConfig`.
        seed: of the samples.

    Returns:
        None where nothing stands out from a support.

    Raises:
        FieldError: the point is not three finite numbers.
    """
    config = config or SurfaceConfig()
    if point.shape != (3,) or not torch.isfinite(point).all():
        raise FieldError(
            f"object_surface: the point must be 3 finite numbers, got shape {tuple(point.shape)}, {point.tolist()}."
        )
    level, upwards = zero_level(field, point, config.around, config, seed)
    plane = support_plane(level, upwards, float(point[2]), config)
    points, normals = zero_level(field, point, config.radius, config, seed)
    standing = (height_over(plane, points) > config.above).nonzero()[:, 0]
    standing = standing[_thinned(points[standing])]
    if eyes is not None:
        standing = standing[in_sight(field, points[standing], eyes, normals[standing])]
    points, normals = points[standing[:MOST]], normals[standing[:MOST]]
    if len(points) == 0 or float((points - point).norm(dim=1).min()) > config.near:
        return None
    part = _joined_to(point, points, config.gap)
    points, normals = points[part], normals[part]
    crowded = _crowded(points)
    points, normals = points[crowded], normals[crowded]
    support = float((points[:, 2] - height_over(plane, points)).median())
    middle = (points.amin(dim=0) + points.amax(dim=0)) / 2
    if eyes is not None and math.isfinite(support):
        sides, outwards, middle = hidden_sides(field, points, support, eyes)
        points, normals = torch.cat([points, sides]), torch.cat([normals, outwards])
    return ObjectSurface(points, normals, support, middle, eyes)


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


def support_plane(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], height: float, config: SurfaceConfig
) -> Float[Tensor, "3"]:
    """The plane a x + b y + c [m] of the largest level face below `height` [m]; c = -inf if there is none.

    A camera's distortion tilts and bends what is level by some millimetres, and flat things are no higher.
    """
    level = points[(normals[:, 2] > 0.9) & (points[:, 2] < height + config.above)]
    if len(level) == 0:
        return torch.tensor([0.0, 0.0, -torch.inf])
    layer = (level[:, 2:] / LAYER).round()
    cells = torch.cat([layer, (level[:, :2] / CELL).round()], dim=1).unique(dim=0)
    layers, sizes = cells[:, 0].unique(return_counts=True)
    near = (level[:, 2] - LAYER * layers[sizes.argmax()]).abs() < LAYER
    plane = torch.stack([torch.zeros(()), torch.zeros(()), level[near, 2].median()])
    ones = torch.ones(len(level), 1)
    for reach in (LAYER, 0.005, 0.003, 0.003):
        on = height_over(plane, level).abs() < reach
        spread = level[on, :2] - level[on, :2].mean(dim=0)
        if int(on.sum()) < 10 or float(torch.linalg.svdvals(spread)[1]) < CELL:
            break  # too few to tell how it is tilted
        plane = torch.linalg.lstsq(torch.cat([level[:, :2], ones], dim=1)[on], level[on, 2:]).solution[:, 0]
    return plane


def height_over(plane: Float[Tensor, "3"], points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """How far points [m] are above a plane a x + b y + c."""
    return points[:, 2] - points[:, :2] @ plane[:2] - plane[2]


def _thinned(points: Tensor) -> Tensor:
    """Numbers of points that lie about evenly: the first in each small cube."""
    _, first = np.unique((points / THIN).floor().numpy(), axis=0, return_index=True)
    return torch.from_numpy(np.sort(first))


def _joined_to(point: Tensor, points: Tensor, gap: float) -> Tensor:
    """Which points hang together with the one nearest to `point`."""
    tree = cKDTree(points.numpy())
    _, labels = connected_components(tree.sparse_distance_matrix(tree, gap))
    part = torch.from_numpy(labels)
    return part == part[int((points - point).norm(dim=1).argmin())]


def _crowded(points: Tensor) -> Tensor:
    """Which points have neighbours: what sticks out alone is noise."""
    tree = cKDTree(points.numpy())
    neighbours = tree.query_ball_point(points.numpy(), NEIGHBOURS, return_length=True) - 1
    return torch.from_numpy(neighbours > LONELY)
