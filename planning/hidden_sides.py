"""The sides of a thing that nobody saw, guessed: under what was seen of its top it goes down to its support."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, grey_closing
from scipy.spatial import cKDTree
from torch import Tensor

from planning.line_of_sight import in_sight
from planning.protocols import DistanceField

CELL = 0.005
"""Edge of a cell of the thing's volume [m]."""
BORDER = 3
"""So many empty cells round it."""


def hidden_sides(
    field: DistanceField, points: Float[Tensor, "n 3"], support: float, eyes: Float[Tensor, "k 3"]
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Float[Tensor, "3"]]:
    """Upright walls where a thing ends out of sight.

    Every column of space is filled from the support up to the highest point that was seen in it, but for what was
    seen to be free. Where the filling ends sideways without a measured point, a wall is guessed.

    Args:
        field: the map.
        points: that were seen of the thing [m].
        support: height of what it stands on [m].
        eyes: where the camera was [m].

    Returns:
        Points of the walls [m], their level unit normals, outwards, and the middle of the filling [m].
    """
    corner = points.amin(dim=0) - BORDER * CELL
    corner[2] = support
    top = _tops(points, corner)
    layers = max(1, int(np.ceil((float(points[:, 2].max()) - support) / CELL)))
    index = np.indices((*top.shape, layers)).reshape(3, -1).T
    centres = corner + CELL * (torch.from_numpy(index).float() + 0.5)
    free = _seen_free(field, centres, eyes).numpy().reshape(*top.shape, layers)
    heights = (np.arange(layers) + 0.5) * CELL
    filled = (heights < top[..., None]) & ~free
    if not filled.any():
        return points[:0], points[:0], points.mean(dim=0)
    middle = corner + CELL * (torch.from_numpy(np.argwhere(filled)).float().mean(dim=0) + 0.5)
    sides, normals = _walls(filled, corner)
    away, _ = cKDTree(points.numpy()).query(sides.numpy())
    guessed = torch.from_numpy(away > 1.5 * CELL)
    return sides[guessed], normals[guessed], middle


def _tops(points: Tensor, corner: Tensor) -> np.ndarray:
    """Height [m] over the corner of the highest point in each column, 0 where there is none; small gaps closed."""
    cells = ((points - corner)[:, :2] / CELL).long().numpy()
    top = np.zeros(cells.max(axis=0) + 1 + BORDER)
    np.maximum.at(top, tuple(cells.T), (points[:, 2] - corner[2]).numpy())
    return grey_closing(top, size=(5, 5))


def _seen_free(field: DistanceField, centres: Tensor, eyes: Tensor) -> Bool[Tensor, " n"]:
    """Which places were seen to be empty."""
    empty = field.distance(centres) > 0.0
    empty[empty.clone()] = in_sight(field, centres[empty], eyes)
    return empty


def _walls(filled: np.ndarray, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Where the filling ends sideways; normals from the slope of the smoothed filling."""
    smooth = gaussian_filter(filled.astype(np.float32), (1.5, 1.5, 1.0))
    slope = -np.stack(np.gradient(smooth, axis=(0, 1)), axis=-1)
    at_edge = np.zeros_like(filled)
    for axis in (0, 1):
        for way in (1, -1):
            at_edge |= filled & ~np.roll(filled, -way, axis=axis)
    wall = np.argwhere(at_edge)
    normal = torch.from_numpy(slope[tuple(wall.T)]).float()
    normal = torch.nn.functional.normalize(torch.nn.functional.pad(normal, (0, 1)), dim=1)
    return corner + CELL * (torch.from_numpy(wall).float() + 0.5), normal
