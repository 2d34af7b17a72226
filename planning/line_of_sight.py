"""What a camera saw of a map: points whose straight way to one of the places it looked from is free."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from planning.protocols import DistanceField

STEP, NEAREST = 0.008, 0.01
"""Of the samples on a line of sight, and how far from the point they begin [m]."""
RANGE = 0.35
"""What hides a thing stands within this of it [m]: it is the thing itself, or stands beside it."""
GRAZING = 0.004
"""A line may dip so far into a surface [m]: maps are not exact, and sides are seen at a slant."""


def in_sight(
    field: DistanceField,
    points: Float[Tensor, "n 3"],
    eyes: Float[Tensor, "k 3"],
    normals: Float[Tensor, "n 3"] | None = None,
) -> Bool[Tensor, " n"]:
    """Which points [m], on faces with unit normals if given, can be seen from at least one of the eyes [m].

    A map that has measured only the front of a thing has a shell there, and a guess behind it: this tells them apart.
    """
    steps = torch.arange(NEAREST, RANGE, STEP)
    seen = torch.zeros(len(points), dtype=torch.bool)
    for eye in eyes:
        rest = (~seen).nonzero()[:, 0]
        for block in rest.split(4096) if len(rest) else ():
            rays = eye - points[block]
            length = rays.norm(dim=1, keepdim=True)
            along = torch.minimum(steps, length)[..., None] * (rays / length.clamp_min(1e-6))[:, None]
            depth = field.distance((points[block, None] + along).reshape(-1, 3)).view(len(block), -1)
            seen[block] = depth.amin(dim=1) >= -GRAZING
            if normals is not None:
                seen[block] &= (normals[block] * rays).sum(dim=1) > 0
    return seen
