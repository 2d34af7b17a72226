"""The zero level set of a distance field as a triangle mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from skimage.measure import marching_cubes
from torch import Tensor

from .errors import ConfigError
from .field import GridField, bake, grid_points

MAX_CELLS = 60_000_000


def zero_level_mesh(
    field: Any,
    spacing: float = 0.04,
    bounds: Float[Tensor, "2 3"] | None = None,
    padding: float = 0.1,
    up: np.ndarray | None = None,
) -> trimesh.Trimesh:
    """Marching cubes over the region a field was learned in; only where its `confidence`, if any, is 0.5 or more.

    Args:
        field: a distance field; `bounds` is taken from it unless given.
        spacing: edge of a cell [m].
        bounds: (2, 3) region [m].
        padding: added on every side [m].
        up: unit vector; faces are shaded by how far they face up. Default z.

    Returns:
        A mesh [m] with outward normals and per-vertex grey shades; without faces where the field has no zero.

    Raises:
        ConfigError: the region at this spacing has more than 60 million cells.
    """
    region = (field.bounds if bounds is None else bounds).float().cpu()
    sides = (region[1] - region[0] + 2 * padding) / spacing
    cells = float(torch.prod(sides))
    if not cells <= MAX_CELLS:
        raise ConfigError(
            f"a mesh at {spacing} m over {[round(float(s * spacing), 1) for s in sides]} m takes {cells:.2g} cells "
            f"(at most {MAX_CELLS:.1g}); choose a spacing of {spacing * (cells / MAX_CELLS) ** (1 / 3):.3f} m or more"
        )
    grid = field if isinstance(field, GridField) and bounds is None else bake(field, region, spacing, padding)
    observed = _observed_cells(field, grid) if hasattr(field, "confidence") else None
    return _march(grid, observed, np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, dtype=float))


def _observed_cells(field: Any, grid: GridField) -> np.ndarray:
    """Which cells have eight corners of some confidence, by their highest corner; of the shape of the grid."""
    known = (field.confidence(grid_points(grid.bounds, grid.spacing)) >= 0.5).cpu().numpy()
    known = known[tuple(slice(n) for n in grid.values.shape)]
    for axis in range(3):
        known &= np.roll(known, 1, axis)
    return known


def _march(grid: GridField, observed: np.ndarray | None, up: np.ndarray) -> trimesh.Trimesh:
    values = grid.values.cpu().numpy()
    if not values.min() < 0 < values.max():
        return trimesh.Trimesh()
    try:
        vertices, faces, _, _ = marching_cubes(
            values, level=0.0, spacing=(grid.spacing,) * 3, gradient_direction="descent", mask=observed
        )
    except RuntimeError:  # no crossing in any of the observed cells
        return trimesh.Trimesh()
    vertices = vertices + grid.origin.cpu().numpy()
    normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    grey = np.clip(255 * (0.55 + 0.35 * (normals @ up)), 30, 255).astype(np.uint8)
    colours = np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=1)
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
