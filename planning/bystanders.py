"""Those who came lately and are close by: the camera looks at them now and then, to know where they are by now.

What a map remembers of somebody who is out of view tells where he was. He may have walked up to the robot's path since,
or may have gone.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from planning.protocols import ChangingField, DistanceField

# Whoever is this near to the axis of the base [m] can stand in its way before he is seen by chance.
REACH = 1.6
# Nearer to it [m] is the robot.
SELF = 0.3
# Lattice on which they are looked for [m], its heights [m], and how near to a lattice point [m] a surface is.
SPACING, HEIGHTS, SURFACE = 0.1, (0.7, 1.1), 0.1
# One look shows what is within this angle of it [rad].
SECTOR = 0.4


def bystanders(field: DistanceField, position: Float[ndarray, "2"]) -> Float[ndarray, "n 2"]:
    """Where somebody who came lately stands about a position [m]: one place [m] for each look, the nearest first."""
    if not isinstance(field, ChangingField):
        return np.empty((0, 2))
    steps = np.arange(-REACH, REACH + SPACING / 2, SPACING)
    offsets = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    away = np.linalg.norm(offsets, axis=1)
    offsets = offsets[(away > SELF) & (away < REACH)]
    offsets = offsets[np.argsort(np.linalg.norm(offsets, axis=1), kind="stable")]
    there = np.zeros(len(offsets), dtype=bool)
    for height in HEIGHTS:
        points = np.column_stack([position + offsets, np.full(len(offsets), height)])
        places = torch.as_tensor(points, dtype=torch.float32)
        came = field.came(places)
        came[came.clone()] = field.distance(places[came]) < SURFACE
        there |= came.numpy()
    return position + _apart(offsets[there])


def _apart(offsets: Float[ndarray, "m 2"]) -> Float[ndarray, "n 2"]:
    """The first of them in each direction."""
    kept: list[ndarray] = []
    bearings = np.arctan2(offsets[:, 1], offsets[:, 0])
    while len(offsets):
        kept.append(offsets[0])
        beside = np.abs(np.angle(np.exp(1j * (bearings - bearings[0])))) > SECTOR
        offsets, bearings = offsets[beside], bearings[beside]
    return np.array(kept).reshape(-1, 2)
