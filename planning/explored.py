"""Space that a mobile base may drive into: what its map has looked at, and where the base has been."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from planning.protocols import ChangingField, ConfidentField, ObservingField
from planning.workspace import MIN_FLOOR_SLOPE

# From this confidence on a place counts as seen, in maps that say no more of it.
SEEN = 0.5
# What is trodden is kept on a grid of this spacing [m].
CELL = 0.05


class Trodden:
    """Where a base has been, on a grid in plan that grows with its way."""

    def __init__(self) -> None:
        self.low = np.zeros(2)
        """Middle of the first cell [m]."""
        self.cells = np.zeros((0, 0), dtype=np.bool_)

    def add(self, position: Float[np.ndarray, "2"], radius: float) -> None:
        """A disc [m] counts as seen from now on."""
        begin = np.floor((position - radius) / CELL).astype(int)
        end = np.ceil((position + radius) / CELL).astype(int) + 1
        first = np.round(self.low / CELL).astype(int) if self.cells.size else begin
        before = np.maximum(first - begin, 0)
        after = np.maximum(end - (first + self.cells.shape), 0)
        self.cells = np.pad(self.cells, np.stack([before, after], axis=1))
        first = first - before
        self.low = CELL * first
        x, y = (CELL * np.arange(begin[axis], end[axis]) - position[axis] for axis in (0, 1))
        part = tuple(slice(*(ends - first[axis])) for axis, ends in enumerate(np.stack([begin, end], axis=1)))
        self.cells[part] |= np.hypot(x[:, None], y) <= radius


class ExploredField:
    """A distance field with confidence 1 where the base may drive and 0 in space nobody has looked at.

    A camera on the robot never sees the space that the robot stands in, but the robot does stand there; so its trail
    counts as seen. What came lately counts as nearer than it was seen to be, in fields that know of it.

    Args:
        field: distances; it tells what was seen by `observed`, or else by `confidence`.
        trodden: where the base has been; what is added to it later counts as well.
        wary: how much nearer [m] what came lately is than the field says.
    """

    def __init__(self, field: ObservingField | ConfidentField, trodden: Trodden, wary: float = 0.0) -> None:
        self.field, self.trodden, self.wary = field, trodden, wary

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distances [m] of the field, to what came as well as to all else."""
        if not self._is_wary:
            return self.field.distance(points)
        exact, gradient = self.field.distance_and_gradient(points)
        distance = self.field.distance(points) if points.requires_grad else exact
        return distance - self._nearer(points, exact, gradient)

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """The same and their gradients."""
        distance, gradient = self.field.distance_and_gradient(points)
        return distance - self._nearer(points, distance, gradient) if self._is_wary else distance, gradient

    def confidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """1 where a point [m] was looked at or is trodden, else 0."""
        seen = self._observed(points).cpu().numpy().ravel()
        _add_trodden(points.detach().cpu().numpy().reshape(-1, 3), self.trodden.low, self.trodden.cells, seen)
        return torch.from_numpy(seen).to(points).view(points.shape[:-1])

    def by_what_came(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """At which points [m] the nearest thing is one that came lately. The floor, on which it stands, has not."""
        if not isinstance(self.field, ChangingField):
            return torch.zeros(points.shape[:-1], dtype=torch.bool)
        return self._came(points, *self.field.distance_and_gradient(points))

    def surface_seen(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """At which points [m] the nearest surface was seen; at all in fields that do not tell how sure they are."""
        if not isinstance(self.field, ConfidentField):
            return torch.ones(points.shape[:-1], dtype=torch.bool)
        return self.field.confidence(self.nearest_surface(points)) >= SEEN

    def nearest_surface(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Where the surface is that is nearest to points [m]."""
        distance, gradient = self.field.distance_and_gradient(points)
        return _on_surface(points, distance, _direction(gradient))

    @property
    def _is_wary(self) -> bool:
        return self.wary > 0 and isinstance(self.field, ChangingField)

    def _nearer(self, points: Tensor, distance: Tensor, gradient: Tensor) -> Float[Tensor, "*batch"]:
        """How much nearer than `distance` something is to points [m]."""
        return self.wary * self._came(points, distance, gradient)

    def _came(self, points: Tensor, distance: Tensor, gradient: Tensor) -> Bool[Tensor, "*batch"]:
        assert isinstance(self.field, ChangingField)
        away = _direction(gradient)
        return self.field.came(_on_surface(points, distance, away)) & (away[..., 2] <= MIN_FLOOR_SLOPE)

    def _observed(self, points: Tensor) -> Bool[Tensor, "*batch"]:
        if isinstance(self.field, ObservingField):
            return self.field.observed(points)
        return self.field.confidence(points) >= SEEN


def _direction(gradient: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Away from the nearest surface. Inside of thin things the gradients of a map are several times too long."""
    return torch.nn.functional.normalize(gradient, dim=-1)


def _on_surface(points: Tensor, distance: Tensor, away: Tensor) -> Float[Tensor, "*batch 3"]:
    """Where the nearest surface is [m], whose direction is opposite to `away`."""
    return points.detach() - distance.unsqueeze(-1) * away


@njit(cache=True, nogil=True)
@no_type_check
def _add_trodden(points, low, trodden, seen):
    """Set `seen` (n,) where points (n, 3) [m] lie in trodden cells of a grid in plan that begins at `low` [m]."""
    for n in range(points.shape[0]):
        x, y = (points[n, 0] - low[0]) / CELL + 0.5, (points[n, 1] - low[1]) / CELL + 0.5
        if 0 <= x < trodden.shape[0] and 0 <= y < trodden.shape[1] and trodden[int(x), int(y)]:
            seen[n] = True
