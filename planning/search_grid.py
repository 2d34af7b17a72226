"""A grid of positions with what a metre of way counts at each, and the cheapest ways over it (Dijkstra)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor


@dataclass(frozen=True, eq=False)
class SearchGrid:
    """Positions and what a metre of way counts there.

    Args:
        positions: (n, 2) [m].
        shape: positions along x and y; n is their product.
        spacing: between neighbours [m].
        cost: (n,) inf where blocked or unknown.
        open: (n,) free, unknown, or blocked only by what is passing.
    """

    positions: Float[Tensor, "n 2"]
    shape: tuple[int, int]
    spacing: float
    cost: Float[Tensor, "n"]
    open: Bool[Tensor, "n"]

    @property
    def free(self) -> Float[Tensor, "f 2"]:
        """Positions that can be driven through [m]."""
        return self.positions[torch.isfinite(self.cost)]

    def nearest(self, place: Float[Tensor, "2"]) -> int:
        """Number of the position closest to a place [m]."""
        return int((self.positions - place).norm(dim=1).argmin())

    def room(self, places: Float[Tensor, "m 2"], robot: Float[Tensor, "2"], apart: float) -> float:
        """Open area [m^2] that can be reached from a place [m] without coming nearer to a robot [m] than `apart` [m].

        Of several places that with the largest area counts; 0 if all that are open are nearer, inf if none is open.
        """
        cells = [self.nearest(place) for place in places]
        if not self.open[cells].any():
            return math.inf
        far = self.open & ((self.positions - robot).norm(dim=1) >= apart)
        regions, _ = label(far.numpy().reshape(self.shape))
        sizes = np.bincount(regions.ravel())
        sizes[0] = 0  # what is nearer, or not open
        return float(sizes[regions.ravel()[cells]].max()) * self.spacing**2

    def nearest_with_room(
        self, start: Float[Tensor, "2"], places: Float[Tensor, "m 2"], apart: float, area: float
    ) -> Float[Tensor, "k 2"]:
        """The cheapest path [m] to where a robot leaves places more `room` [m^2]; the start, if nowhere."""
        reach, before = cheapest(self.cost, self.shape, self.spacing, self.nearest(start))
        far = -math.inf
        for cell in reach.argsort().tolist():
            if not math.isfinite(reach[cell]):
                break
            if reach[cell] < far + 2 * self.spacing:
                continue
            far = float(reach[cell])
            if self.room(places, self.positions[cell], apart) > area:
                return torch.cat([start[None], self.positions[traced(before, cell)][1:]])
        return start[None]

    def way_back(
        self, start: Float[Tensor, "2"], place: Float[Tensor, "2"], distance: float
    ) -> Float[Tensor, "k 2"]:
        """The cheapest path [m] from start to where it is `distance` [m] from a place, or else as far as can be."""
        reach, before = cheapest(self.cost, self.shape, self.spacing, self.nearest(start))
        away = (self.positions - place).norm(dim=1).masked_fill(~torch.isfinite(reach), -torch.inf)
        far = away >= min(distance, float(away.max()))
        end = int(reach.masked_fill(~far, torch.inf).argmin())
        return torch.cat([start[None], self.positions[traced(before, end)][1:]])


def cheapest(
    cost: Float[Tensor, "n"], shape: tuple[int, int], spacing: float, start: int
) -> tuple[Float[Tensor, "n"], Int[ndarray, "n"]]:
    """What it costs to reach every cell, inf where it cannot be, and the cell before it on the way."""
    graph = _graph(cost.numpy().astype(float), shape, spacing)
    reach, before = dijkstra(graph, indices=start, return_predecessors=True)
    return torch.as_tensor(reach), before


def traced(before: Int[ndarray, "n"], end: int) -> list[int]:
    """The cells of the way to the last one."""
    cells = [end]
    while before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    return cells[::-1]


def _graph(cost: Float[ndarray, "n"], shape: tuple[int, int], spacing: float) -> csr_array:
    """The 8 neighbours of every free cell, with the length times the mean cost of both ends."""
    index = np.arange(len(cost)).reshape(shape)
    rows, columns, weights = [], [], []
    for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
        here = index[: shape[0] - di, max(0, -dj) : shape[1] - max(0, dj)].ravel()
        there = index[di:, max(0, dj) : shape[1] + min(0, dj)].ravel()
        weight = spacing * np.hypot(di, dj) * 0.5 * (cost[here] + cost[there])
        free = np.isfinite(weight)
        rows += [here[free], there[free]]
        columns += [there[free], here[free]]
        weights += [weight[free], weight[free]]
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    return csr_array(entries, shape=(len(cost), len(cost)))
