"""The zero level of a map as a mesh that is made every second or so: coarser for larger maps."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from .state import Colour, Shape

CELLS = 1_200_000
"""A mesh is made of so many cells at most."""
LEAST_SPACING = 0.04
"""[m]"""
COLOUR: Colour = (176, 188, 198)


def spacing_for(bounds: torch.Tensor) -> float:
    """Edge of the cells [m] for a map with these bounds (2, 3) [m]."""
    volume = float(torch.prod((bounds[1] - bounds[0]).clamp(min=0.1) + 0.2))
    return max(LEAST_SPACING, (volume / CELLS) ** (1 / 3))


def surface_of(field: Any) -> Shape:
    """The zero level where the map is sure of it; it faces what is free."""
    from ..meshing import zero_level_mesh

    mesh = zero_level_mesh(field, spacing_for(field.bounds), bounds=field.bounds)
    vertices = np.asarray(mesh.vertices if len(mesh.faces) else np.zeros((0, 3)), np.float32)
    return Shape(vertices, np.asarray(mesh.faces, np.uint32).reshape(-1, 3), COLOUR)
