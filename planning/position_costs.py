"""What a metre of way counts at positions of a base: free, blocked, unknown, guessed, or blocked for a while."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from planning.errors import ConfigError
from planning.numbers import refuse_nan
from planning.protocols import DistanceField, SphereRobot, SurveyedField
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
        through_guessed: the same for a way through obstacles that were not seen, in fields that tell those that they
            guess: to go and see is worth a detour that a wall is not worth.
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
    through_guessed: float = math.inf
    through_passing: float = 1.5
    closed_radius: float = 0.6
    workspace: WorkspaceConfig = field(default_factory=WorkspaceConfig)

    def __post_init__(self) -> None:
        refuse_nan(self)
        through = (self.through_blocked, self.through_unknown, self.through_guessed, self.through_passing)
        prices = min(self.caution, *through)
        if min(self.spacing, self.padding) <= 0 or self.margin <= self.least_margin or not prices >= 1:
            raise ConfigError(
                "GridSearchConfig: spacing and padding must be positive, margin above least_margin, and caution and "
                "the prices of ways through what is blocked, unknown, guessed or passing at least 1, got "
                f"{self}."
            )


class PositionCosts(NamedTuple):
    """What a metre of way counts at each position.

    Args:
        free: inf where blocked or unknown.
        waiting: with what is passing at its price.
        price: with all that is blocked or unknown at its price.
        open: free, unknown, or blocked only by what is passing.
    """

    free: Float[Tensor, "n"]
    waiting: Float[Tensor, "n"]
    price: Float[Tensor, "n"]
    open: Bool[Tensor, "n"]


def position_costs(
    robot: SphereRobot,
    sdf: DistanceField,
    positions: Float[Tensor, "n 2"],
    start: Float[Tensor, "2"],
    config: GridSearchConfig,
    passing: Passing | None,
) -> PositionCosts:
    """Look at every position [m]. Arguments as for `planning.grid_search.grid_search`."""
    workspace = Workspace(robot, sdf, eps=1.0, config=config.workspace)
    away = (positions - start).norm(dim=1)
    here = int(away.argmin())
    body = _Body(*robot.spheres(positions[here]), positions[here])
    found = _by_a_few(body, workspace, positions, config.least_margin)
    unknown = torch.zeros(len(positions), dtype=torch.bool)
    # What a few spheres find blocked is blocked, and what is unknown is but guessed to be free: neither need be known
    # better, except where the robot may escape.
    near = away <= config.escape
    for block in ((found.clearance >= config.least_margin) | near).nonzero()[:, 0].split(500):
        centres = body.at(positions[block])
        hidden = workspace.unknown(centres)
        if hidden is not None:
            unknown[block] = hidden.any(dim=-1)
            closer = ~unknown[block] | near[block]
            block, centres = block[closer], centres[closer]
        clearance = workspace.clearance(centres, body.radii)
        found.take(block, workspace, centres, body.radii, clearance, config.least_margin)
    clearance = found.clearance
    short = ((config.margin - clearance) / (config.margin - config.least_margin)).clamp(min=0.0)
    escape = near & (clearance >= clearance[here]) & (unknown <= unknown[here])
    solid = ~(clearance >= config.least_margin) & ~escape  # NaN is blocked
    unknown &= ~escape
    price = (1 + (config.caution - 1) * short).masked_fill(solid, config.through_blocked)
    cost = price.masked_fill(solid | unknown, torch.inf)
    price = price.masked_fill(solid & ~found.seen, min(config.through_guessed, config.through_blocked))
    price = price.masked_fill(unknown & ~solid, config.through_unknown)
    waiting, open_ = cost.clone(), ~solid
    if passing is not None and solid.any():
        gone = solid.clone()
        gone[solid] = passing(positions[solid], found.deepest[solid])
        waiting[gone] = price[gone] = config.through_passing
        open_ |= gone
    return PositionCosts(cost, waiting, price, open_)


class _Body(NamedTuple):
    """The spheres of a robot with q = (x, y), which moves them along.

    Args:
        centres: where it is at a position [m].
        radii: [m].
        position: which.
    """

    centres: Float[Tensor, "s 3"]
    radii: Float[Tensor, " s"]
    position: Float[Tensor, "2"]

    def at(self, positions: Float[Tensor, "m 2"]) -> Float[Tensor, "m s 3"]:
        """The centres [m] at other positions."""
        return self.centres + torch.nn.functional.pad(positions - self.position, (0, 1))[:, None]

    def some(self, which: Int[Tensor, " few"]) -> _Body:
        """A part of the spheres."""
        return _Body(self.centres[which], self.radii[which], self.position)


@dataclass(frozen=True, eq=False)
class _Found:
    """What is in the way of the spheres at each position.

    Args:
        clearance: the least of any sphere [m].
        deepest: that sphere's centre [m].
        seen: whether a surface that was seen cuts into a sphere, and not only one that the field guesses; or the field
            is NaN.
    """

    clearance: Float[Tensor, "n"]
    deepest: Float[Tensor, "n 3"]
    seen: Bool[Tensor, "n"]

    def take(
        self,
        rows: Int[Tensor, " m"],
        workspace: Workspace,
        centres: Float[Tensor, "m s 3"],
        radii: Float[Tensor, " s"],
        clearance: Float[Tensor, "m s"],
        least: float,
    ) -> None:
        """Enter some positions' spheres [m] and their clearances [m], of which `least` [m] is asked."""
        self.clearance[rows], which = clearance.min(dim=-1)
        self.deepest[rows] = centres[torch.arange(len(rows)), which]
        if not isinstance(workspace.field, SurveyedField):
            self.seen[rows] = True
            return
        # Spheres inside of an obstacle are not cut by its surface, and nobody has seen what is there.
        cut = (clearance < least) & (clearance > -2 * radii)
        seen = torch.zeros_like(cut)
        if cut.any():
            seen[cut] = workspace.field.surface_seen(centres[cut])
        self.seen[rows] = seen.any(dim=-1) | self.clearance[rows].isnan()


def _by_a_few(body: _Body, workspace: Workspace, positions: Float[Tensor, "n 2"], least: float) -> _Found:
    """What is found by every eighth sphere that may not touch the floor."""
    n = len(positions)
    found = _Found(
        torch.full((n,), torch.inf, dtype=positions.dtype),
        torch.zeros((n, 3), dtype=positions.dtype),
        torch.zeros(n, dtype=torch.bool),
    )
    which = torch.arange(len(body.radii))
    if workspace.floor is not None:
        which = which[~workspace.floor]
    few = body.some(which[::8])
    for block in torch.arange(n).split(2000) if len(few.radii) else ():
        centres = few.at(positions[block])
        clearance = workspace.field.distance(centres) - few.radii
        found.take(block, workspace, centres, few.radii, clearance, least)
    return found
