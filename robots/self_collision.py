"""How near a robot comes to touching itself, by its spheres."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from robots.model import Robot

CHUNK = 50
"""So many postures at a time, to bound memory."""


def self_gaps(robot: Robot, q: Float[Tensor, "n dof"]) -> Float[Tensor, " n"]:
    """Least gap [m] between spheres of links that must not touch; inf where there are none."""
    first, second = robot.self_collision_pairs.unbind(-1)
    if len(first) == 0:
        return q.new_full((len(q),), torch.inf)
    gaps = []
    for part in q.split(CHUNK):
        centres, radii = robot.spheres(part)
        distances = (centres[:, first] - centres[:, second]).norm(dim=-1)
        gaps.append((distances - radii[first] - radii[second]).amin(-1))
    return torch.cat(gaps)
