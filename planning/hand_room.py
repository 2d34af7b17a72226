"""Room for an open hand: its clearance at a grasp and on the way there, and how much of it stays in seen space."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from planning.line_of_sight import in_sight
from planning.object_surface import ObjectSurface
from planning.protocols import DistanceField

CELL = 0.01
"""Of the lattice that knows which space was seen [m]."""
AROUND = 0.05
"""So far round an object [m] the space behind it is told from space that was seen."""
FINGER = 0.04
"""What lies this near to the tips is a finger [m]."""


@dataclass(frozen=True, eq=False)
class ParallelHand:
    """An open hand in its tool frame: z along the fingers, y from one finger to the other, the origin between the tips.

    Args:
        centres: (s, 3) of balls that cover hand and fingers [m].
        radii: (s,) [m].
        opening: between the fingers [m].
        tips: how far the fingers reach beyond the origin [m].
    """

    centres: Float[Tensor, "s 3"]
    radii: Float[Tensor, " s"]
    opening: float
    tips: float

    def below(self, turn: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n"]:
        """How far the hand reaches below its origin [m] when it is turned so."""
        return (self.radii - (self.centres @ turn[..., 2, :, None]).squeeze(-1)).amax(dim=-1)


class RoomRound:
    """The space round an object: a field where it was seen, the object's surface where it was not.

    Args:
        field: the map.
        surface: of the object; all is taken for seen if nobody knows from where it was looked at.
    """

    def __init__(self, field: DistanceField, surface: ObjectSurface) -> None:
        self.field, self.surface = field, surface
        self._tree = cKDTree(surface.points.numpy())
        self._low = surface.points.amin(dim=0) - AROUND
        size = ((surface.points.amax(dim=0) + AROUND - self._low) / CELL).long() + 1
        self._hidden = torch.zeros(*size.tolist(), dtype=torch.bool)
        if surface.eyes is not None:
            cells = torch.cartesian_prod(*(torch.arange(n) for n in size.tolist()))
            seen = in_sight(field, self._low + CELL * (cells + 0.5), surface.eyes)
            self._hidden = ~seen.view(self._hidden.shape)

    def hidden(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Which places nobody saw."""
        cells = ((points - self._low) / CELL).floor().long()
        size = torch.tensor(self._hidden.shape)
        inside = ((cells >= 0) & (cells < size)).all(dim=1)
        cells = torch.minimum(cells.clamp_min(0), size - 1)
        return inside & self._hidden[tuple(cells.T)]

    def distance(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Signed distance [m]: behind a thing the map only guesses, and may take all of it for solid."""
        distance = self.field.distance(points)
        hidden = self.hidden(points)
        if bool(hidden.any()):
            away, nearest = self._tree.query(points[hidden].numpy())
            offset = points[hidden] - self.surface.points[nearest]
            outside = (offset * self.surface.normals[nearest]).sum(dim=1) > 0
            to_surface = torch.from_numpy(away).to(distance)
            to_support = points[hidden, 2] - self.surface.support
            distance[hidden] = torch.minimum(to_surface.where(outside, -to_surface), to_support)
        return distance

    def clearance(
        self, T_world_tool: Float[Tensor, "n 4 4"], hand: ParallelHand, retreat: float
    ) -> Float[Tensor, " n"]:
        """Least clearance [m] of an open hand at poses and on the straight ways to them, `retreat` [m] long."""
        clearance = torch.full((len(T_world_tool),), torch.inf)
        for back in torch.linspace(0.0, retreat, 4).tolist():
            local = hand.centres - torch.tensor([0.0, 0.0, back])
            for block in torch.arange(len(T_world_tool)).split(256):
                T = T_world_tool[block]
                centres = local @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
                gaps = self.distance(centres.reshape(-1, 3)).view(centres.shape[:2]) - hand.radii
                clearance[block] = torch.minimum(clearance[block], gaps.amin(dim=1))
        return clearance

    def seen_share(self, T_world_tool: Float[Tensor, "n 4 4"], hand: ParallelHand) -> Float[Tensor, " n"]:
        """Share of a finger that is in seen space, the lesser of both: behind an object may be more of it."""
        fingers = hand.centres[hand.centres[:, 2] > -FINGER]
        centres = fingers @ T_world_tool[:, :3, :3].transpose(1, 2) + T_world_tool[:, None, :3, 3]
        seen = ~self.hidden(centres.reshape(-1, 3)).view(centres.shape[:2])
        sides = [seen[:, side].float().mean(dim=1) for side in (fingers[:, 1] > 0, fingers[:, 1] < 0)]
        return torch.minimum(*sides)
