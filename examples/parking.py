"""Where a mobile manipulator can stand to reach for something."""

from __future__ import annotations

import math

import numpy as np
import torch

from planning.protocols import DistanceField, SphereRobot
from planning.workspace import Workspace

DISTANCES = (0.6, 0.7, 0.8)
"""From the middle of the base to the thing [m]."""
HEADINGS = 24


def parking_places(
    body: SphereRobot, field: DistanceField, point: np.ndarray, here: np.ndarray, room: float = 0.03
) -> list[tuple[float, float, float]]:
    """Base poses (x, y [m], yaw [rad]) that face a point [m], the most convenient from (x, y) `here` first.

    The base has `room` [m] at them in the map, turned any way.
    """
    yaw = torch.arange(HEADINGS) * (2 * math.pi / HEADINGS)
    back = torch.tensor(DISTANCES)
    yaw, back = (grid.reshape(-1) for grid in torch.meshgrid(yaw, back, indexing="ij"))
    target = torch.as_tensor(point[:2], dtype=torch.float32)
    places = target - back[:, None] * torch.stack([yaw.cos(), yaw.sin()], dim=1)
    clearance = Workspace(body, field, eps=1.0).clearance(*body.spheres(places)).amin(dim=1)
    position = torch.as_tensor(here[:2], dtype=torch.float32)
    way = (places - position).norm(dim=1)
    turn = (yaw - torch.atan2(*(target - position).flip(0))).remainder(2 * math.pi)
    turn = torch.minimum(turn, 2 * math.pi - turn)
    # Near the thing the arm reaches best; a little more room than needed is worth a detour.
    cost = way + 2.0 * back + 0.3 * turn + 5.0 * (room + 0.07 - clearance).clamp_min(0.0)
    order = [int(i) for i in cost.argsort() if clearance[i] >= room]
    return [(*places[i].tolist(), float((yaw[i] + math.pi) % (2 * math.pi) - math.pi)) for i in order]
