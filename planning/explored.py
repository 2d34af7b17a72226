"""Space that a mobile base may drive into: what its map has looked at, and where the base has been."""

from __future__ import annotations

from typing import no_type_check

import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from planning.protocols import ConfidentField, ObservingField

# From this confidence on a place counts as seen, in maps that say no more of it.
SEEN = 0.5
# What is trodden is kept on a grid of this spacing [m].
CELL = 0.05


class ExploredField:
    """A distance field with confidence 1 where the base may drive and 0 in space nobody has looked at.

    A camera on the robot never sees the space that the robot stands in, but the robot does stand there; so its trail
    counts as seen.

    Args:
        field: distances; it tells what was seen by `observed`, or else by `confidence`.
        trodden: (n, 3) discs in plan that count as seen, at least one: x, y and radius [m].
    """

    def __init__(self, field: ObservingField | ConfidentField, trodden: Float[Tensor, "n 3"]) -> None:
        self.field = field
        middle, radius = trodden[:, :2], trodden[:, 2:]
        low, high = (middle - radius).amin(dim=0), (middle + radius).amax(dim=0)
        axes = [torch.arange(float(low[i]), float(high[i]) + CELL, CELL, dtype=trodden.dtype) for i in (0, 1)]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
        inside = (torch.cdist(grid.view(-1, 2), middle) <= radius.T).any(dim=1)
        self._low, self._trodden = low.numpy(), inside.view(grid.shape[:2]).numpy()

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distances [m] of the field."""
        return self.field.distance(points)

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distances [m] of the field and their gradients."""
        return self.field.distance_and_gradient(points)

    def confidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """1 where a point [m] was looked at or is trodden, else 0."""
        seen = self._observed(points).cpu().numpy().ravel()
        _add_trodden(points.detach().cpu().numpy().reshape(-1, 3), self._low, self._trodden, seen)
        return torch.from_numpy(seen).to(points).view(points.shape[:-1])

    def _observed(self, points: Tensor) -> Bool[Tensor, "*batch"]:
        if isinstance(self.field, ObservingField):
            return self.field.observed(points)
        return self.field.confidence(points) >= SEEN


@njit(cache=True, nogil=True)
@no_type_check
def _add_trodden(points, low, trodden, seen):
    """Set `seen` (n,) where points (n, 3) [m] lie in trodden cells of a grid in plan that begins at `low` [m]."""
    for n in range(points.shape[0]):
        x, y = (points[n, 0] - low[0]) / CELL + 0.5, (points[n, 1] - low[1]) / CELL + 0.5
        if 0 <= x < trodden.shape[0] and 0 <= y < trodden.shape[1] and trodden[int(x), int(y)]:
            seen[n] = True
