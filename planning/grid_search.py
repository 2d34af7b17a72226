"""A first path for a base: Dijkstra over a grid of positions, so that none is missed and the roomiest is preferred."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from planning.errors import ConfigError, TrajectoryError
from planning.numbers import refuse_nan
from planning.protocols import DistanceField, SphereRobot
from planning.workspace import Workspace, WorkspaceConfig

Passing = Callable[[Float[Tensor, "m 2"], Float[Tensor, "m 3"]], Bool[Tensor, " m"]]


@dataclass(frozen=True)
class GridSearchConfig:
    """How positions are searched.

    Args:
        spacing: of the grid [m].
        padding: the grid reaches this far beyond start and goal [m].
        margin: clearance [m] from which on a position costs no more than its length.
        least_margin: clearance [m] below which a position is blocked. May be negative for a map that is still some
            centimetres wrong.
        caution: how many times longer a way at the least margin counts than one at the margin.
        escape: where the start is blocked, positions this near to it [m] are not, unless they are less clear: the
            robot stands there and may leave, but not go in deeper.
        through_blocked: how many times longer a way through obstacles counts than a free one, for maps that may be
            wrong about them. Where no free way leads to the goal, the route then follows the cheapest way through
            blocked space up to where that begins, such as a doorway. inf: never.
        through_unknown: the same for a way through unknown space, however near to something the field guesses it to
            be: else the route would lead through a wall that was seen rather than round it.
        through_passing: the same for a way through what is likely to have moved on when the robot gets there. Where the
            way round it counts more, the route ends before it even though a free way leads to the goal.
        closed_radius: blocked space this near [m] to a closed place is never entered.
        workspace: rules for the floor and for unknown space, which counts as blocked.
    """

    spacing: float = 0.1
    padding: float = 3.0
    margin: float = 0.15
    least_margin: float = 0.0
    caution: float = 10.0
    escape: float = 0.25
    through_blocked: float = math.inf
    through_unknown: float = math.inf
    through_passing: float = 3.0
    closed_radius: float = 0.6
    workspace: WorkspaceConfig = field(default_factory=WorkspaceConfig)

    def __post_init__(self) -> None:
        refuse_nan(self)
        prices = min(self.caution, self.through_blocked, self.through_unknown, self.through_passing)
        if min(self.spacing, self.padding) <= 0 or self.margin <= self.least_margin or not prices >= 1:
            raise ConfigError(
                "GridSearchConfig: spacing and padding must be positive, margin above least_margin and caution, "
                f"through_blocked, through_unknown and through_passing at least 1, got {self}."
            )


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

    def room(self, way: Float[Tensor, "m 2"], robot: Float[Tensor, "2"], apart: float) -> float:
        """Open area [m^2] that can be reached from a way [m] without coming nearer to a robot [m] than `apart` [m].

        Of several areas that the way leads through the largest; inf if it is nowhere open and so far away.
        """
        far = self.open & ((self.positions - robot).norm(dim=1) >= apart)
        regions, _ = label(far.numpy().reshape(self.shape))
        on_way = regions.ravel()[[self.nearest(place) for place in way]]
        sizes = np.bincount(regions.ravel())[on_way[on_way > 0]]
        return float(sizes.max()) * self.spacing**2 if len(sizes) else math.inf

    def nearest_with_room(
        self, start: Float[Tensor, "2"], way: Float[Tensor, "m 2"], apart: float, area: float
    ) -> Float[Tensor, "k 2"]:
        """The cheapest path [m] to where a robot leaves more `room` than an area [m^2]; or the start, if nowhere."""
        reach, before = _search(self.cost, self.shape, self.spacing, self.nearest(start))
        far = -math.inf
        for cell in reach.argsort().tolist():
            if not math.isfinite(reach[cell]):
                break
            if reach[cell] < far + 2 * self.spacing:
                continue
            far = float(reach[cell])
            if self.room(way, self.positions[cell], apart) > area:
                return torch.cat([start[None], self.positions[_traced(before, cell)][1:]])
        return start[None]

    def way_back(
        self, start: Float[Tensor, "2"], place: Float[Tensor, "2"], distance: float
    ) -> Float[Tensor, "k 2"]:
        """The cheapest path [m] from start to where it is `distance` [m] from a place, or else as far as can be."""
        reach, before = _search(self.cost, self.shape, self.spacing, self.nearest(start))
        away = (self.positions - place).norm(dim=1).masked_fill(~torch.isfinite(reach), -torch.inf)
        far = away >= min(distance, float(away.max()))
        end = int(reach.masked_fill(~far, torch.inf).argmin())
        return torch.cat([start[None], self.positions[_traced(before, end)][1:]])


@dataclass(frozen=True, eq=False)
class Route:
    """A path over the grid.

    Args:
        path: (k, 2) positions [m] from the start to the goal; or to where blocked space would have to be entered; or
            to the reachable place nearest to the goal.
        reaches_goal: whether it ends at the goal.
        onward: (m, 2) how it would go on to the goal through blocked space [m]; empty where it reaches the goal or no
            such way is left.
        grid: what it was searched on.
    """

    path: Float[Tensor, "k 2"]
    reaches_goal: bool
    onward: Float[Tensor, "m 2"]
    grid: SearchGrid

    @property
    def entry(self) -> Float[Tensor, "2"] | None:
        """The blocked position (2,) that comes next [m], if the path ends before one."""
        return self.onward[0] if len(self.onward) else None


def grid_search(
    robot: SphereRobot,
    sdf: DistanceField,
    start: Float[Tensor, "2"],
    goal: Float[Tensor, "2"],
    config: GridSearchConfig | None = None,
    closed: Float[Tensor, "c 2"] | None = None,
    passing: Passing | None = None,
) -> Route:
    """Search the cheapest path of a robot with q = (x, y).

    Args:
        robot: two joints, metres.
        sdf: the field to keep clear of.
        start: position [m].
        goal: position [m].
        config: see `GridSearchConfig`.
        closed: places [m] where blocked space was found to be blocked indeed.
        passing: tells of blocked positions (m, 2) [m], and of the centres (m, 3) [m] of the spheres that are deepest in
            what blocks them, whether that is likely to move on (m,).

    Raises:
        TrajectoryError: if the robot has not two joints, or start or goal is not finite.
    """
    config = config or GridSearchConfig()
    if robot.num_dofs != 2:
        raise TrajectoryError(f"grid_search: the robot must have 2 joints (x, y), got {robot.num_dofs}.")
    if not torch.isfinite(torch.stack([start, goal])).all():
        raise TrajectoryError(
            f"grid_search: start and goal must be finite, got {start.tolist()} and {goal.tolist()}."
        )
    positions, shape = _grid(start, goal, config)
    costs = _costs(robot, sdf, positions, start, config, passing)
    grid = SearchGrid(positions, shape, config.spacing, costs.free, costs.open)
    near_start, near_goal = grid.nearest(start), grid.nearest(goal)
    shut = torch.zeros(len(positions), dtype=torch.bool)
    if closed is not None and len(closed):
        shut = torch.isinf(costs.free) & (torch.cdist(positions, closed).amin(dim=1) <= config.closed_radius)
    for cost in (costs.waiting, costs.price):
        reach, before = _search(cost.masked_fill(shut, torch.inf), shape, config.spacing, near_start)
        if torch.isfinite(reach[near_goal]):
            return _up_to_what_blocks(grid, _traced(before, near_goal), start, goal)
    reach, before = _search(costs.free, shape, config.spacing, near_start)
    gap = (positions - goal).norm(dim=1).masked_fill(~torch.isfinite(reach), torch.inf)
    cells = _traced(before, int(gap.argmin()))
    return Route(torch.cat([start[None], positions[cells][1:]]), False, positions[:0], grid)


def _up_to_what_blocks(grid: SearchGrid, cells: list[int], start: Tensor, goal: Tensor) -> Route:
    """The route along some cells to the goal, or to the first that is blocked."""
    blocked, way = torch.isinf(grid.cost[cells]), grid.positions[cells]
    if blocked.any():
        first = int(blocked.float().argmax())
        return Route(torch.cat([start[None], way[1:first]]), False, way[first:], grid)
    return Route(torch.cat([start[None], way[1:-1], goal[None]]), True, way[:0], grid)


def _search(
    cost: Float[Tensor, "n"], shape: tuple[int, int], spacing: float, start: int
) -> tuple[Float[Tensor, "n"], Int[ndarray, "n"]]:
    """What it costs to reach every cell, inf where it cannot be, and the cell before it on the way."""
    graph = _graph(cost.numpy().astype(float), shape, spacing)
    reach, before = dijkstra(graph, indices=start, return_predecessors=True)
    return torch.as_tensor(reach), before


def _traced(before: Int[ndarray, "n"], end: int) -> list[int]:
    """The cells of the way to the last one."""
    cells = [end]
    while before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    return cells[::-1]


def _grid(
    start: Tensor, goal: Tensor, config: GridSearchConfig
) -> tuple[Float[Tensor, "n 2"], tuple[int, int]]:
    """Positions on a grid through the start, around start and goal."""
    ends = torch.stack([start, goal])
    low = ((ends.amin(dim=0) - config.padding - start) / config.spacing).floor()
    high = ((ends.amax(dim=0) + config.padding - start) / config.spacing).ceil()
    axes = [
        start[i] + config.spacing * torch.arange(int(low[i]), int(high[i]) + 1, dtype=start.dtype)
        for i in (0, 1)
    ]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    return grid.reshape(-1, 2), (len(axes[0]), len(axes[1]))


class _Costs(NamedTuple):
    """What a metre of way counts at each position.

    Args:
        free: inf where blocked or unknown.
        waiting: with what is passing at its price.
        price: with all that is blocked or unknown at its price.
        open: see `SearchGrid`.
    """

    free: Float[Tensor, "n"]
    waiting: Float[Tensor, "n"]
    price: Float[Tensor, "n"]
    open: Bool[Tensor, "n"]


def _costs(
    robot: SphereRobot,
    sdf: DistanceField,
    positions: Tensor,
    start: Tensor,
    config: GridSearchConfig,
    passing: Passing | None,
) -> _Costs:
    workspace = Workspace(robot, sdf, eps=1.0, config=config.workspace)
    away = (positions - start).norm(dim=1)
    here = int(away.argmin())
    clearance, deepest = _clearance_of_a_few(robot, workspace, positions)
    unknown = torch.zeros(len(positions), dtype=torch.bool)
    # What a few spheres find blocked is blocked, and need not be known better, except where the robot may escape.
    for block in ((clearance >= config.least_margin) | (away <= config.escape)).nonzero()[:, 0].split(500):
        centres, radii = robot.spheres(positions[block])
        clearance[block], which = workspace.clearance(centres, radii).min(dim=-1)
        deepest[block] = centres[torch.arange(len(block)), which]
        hidden = workspace.unknown(centres)
        if hidden is not None:
            unknown[block] = hidden.any(dim=-1)
    short = ((config.margin - clearance) / (config.margin - config.least_margin)).clamp(min=0.0)
    escape = (away <= config.escape) & (clearance >= clearance[here]) & (unknown <= unknown[here])
    solid = ~(clearance >= config.least_margin) & ~escape  # NaN is blocked
    unknown &= ~escape
    price = (1 + (config.caution - 1) * short).masked_fill(solid, config.through_blocked)
    cost = price.masked_fill(solid | unknown, torch.inf)
    price = price.masked_fill(unknown & ~solid, config.through_unknown)
    waiting, open_ = cost.clone(), ~solid
    if passing is not None and solid.any():
        gone = solid.clone()
        gone[solid] = passing(positions[solid], deepest[solid])
        waiting[gone] = price[gone] = config.through_passing
        open_ |= gone
    return _Costs(cost, waiting, price, open_)


def _clearance_of_a_few(
    robot: SphereRobot, workspace: Workspace, positions: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """The least clearance [m] of every eighth sphere that may not touch the floor, and that sphere's centre [m]."""
    few = torch.arange(len(robot.spheres(positions[:1])[1]))
    if workspace.floor is not None:
        few = few[~workspace.floor]
    few = few[::8]
    least = torch.full((len(positions),), torch.inf, dtype=positions.dtype)
    deepest = torch.zeros((len(positions), 3), dtype=positions.dtype)
    for block in torch.arange(len(positions)).split(2000) if len(few) else ():
        centres, radii = robot.spheres(positions[block])
        centres = centres[:, few]
        least[block], which = (workspace.field.distance(centres) - radii[few]).min(dim=-1)
        deepest[block] = centres[torch.arange(len(block)), which]
    return least, deepest


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
