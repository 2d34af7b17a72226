"""A first path for a base: Dijkstra over a grid of positions, so that none is missed and the roomiest is preferred."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from planning.errors import TrajectoryError
from planning.position_costs import GridSearchConfig, Passing, position_costs
from planning.protocols import DistanceField, SphereRobot
from planning.search_grid import SearchGrid, cheapest, traced


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
    costs = position_costs(robot, sdf, positions, start, config, passing)
    grid = SearchGrid(positions, shape, config.spacing, costs.free, costs.open)
    near_start, near_goal = grid.nearest(start), grid.nearest(goal)
    shut = torch.zeros(len(positions), dtype=torch.bool)
    if closed is not None and len(closed):
        shut = torch.isinf(costs.free) & (torch.cdist(positions, closed).amin(dim=1) <= config.closed_radius)
    for cost in (costs.waiting, costs.price):
        reach, before = cheapest(cost.masked_fill(shut, torch.inf), shape, config.spacing, near_start)
        if torch.isfinite(reach[near_goal]):
            return _up_to_what_blocks(grid, traced(before, near_goal), start, goal)
    reach, before = cheapest(costs.free, shape, config.spacing, near_start)
    gap = (positions - goal).norm(dim=1).masked_fill(~torch.isfinite(reach), torch.inf)
    cells = traced(before, int(gap.argmin()))
    return Route(torch.cat([start[None], positions[cells][1:]]), False, positions[:0], grid)


def _up_to_what_blocks(grid: SearchGrid, cells: list[int], start: Tensor, goal: Tensor) -> Route:
    """The route along some cells to the goal, or to the first that is blocked."""
    blocked, way = torch.isinf(grid.cost[cells]), grid.positions[cells]
    if blocked.any():
        first = int(blocked.float().argmax())
        return Route(torch.cat([start[None], way[1:first]]), False, way[first:], grid)
    return Route(torch.cat([start[None], way[1:-1], goal[None]]), True, way[:0], grid)


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
