"""Plans for a mobile base in a map that is still being learned: search, then CHOMP, and a memory of dead ends."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from planning.chomp import Chomp, ChompConfig
from planning.descent import DescentConfig
from planning.errors import ConfigError
from planning.explored import ExploredField, Trodden
from planning.giving_way import path_length
from planning.grid_search import Route, grid_search
from planning.numbers import refuse_nan
from planning.once_free import OnceFree
from planning.position_costs import GridSearchConfig
from planning.protocols import ConfidentField, DistanceField, ObservingField, SphereRobot
from planning.result import PlanResult
from planning.threads import one_thread
from planning.trajectory import Trajectory
from planning.vain_looks import VainLooks
from planning.validation import check
from planning.workspace import Workspace, WorkspaceConfig

# Waypoints of a plan, however short, if it may have as many.
MIN_WAYPOINTS = 12


@dataclass(frozen=True)
class BasePlannerConfig:
    """How the base plans.

    Args:
        search: finds the route that CHOMP starts from; its rules for unknown space are those of plans.
        chomp: the optimiser; its margin is set by the planner.
        num_waypoints: of a plan, at most.
        spacing: between its waypoints [m], closer where it would have less than a dozen.
        margin: clearance [m] that plans keep where the map has a route with as much.
        clearance_change: a plan is no longer good when the map has taken this much [m] of its clearance.
        off_path: nor when the base is this far [m] from it, for it was pushed or its wheels slipped.
        looks: how often the robot stands before blocked space and looks, before it counts as blocked.
        looks_came: the same where something came, which may go again: other ways lead through space that is blocked or
            unknown as well, and whoever sets off for one after a moment is seldom there earlier.
        memory: blocked space is given another chance after this long [s], for the world changes.
        stand_off: the base comes no nearer [m] to what came into the way, to see all of it down to the floor and to let
            it pass; and backs off so far from other blocked space when it looks at it for the last time.
        wary: clearance [m] that is kept, on top of all others, from what came lately: it may move on, and its far side
            was not seen.
        room: unknown space this near [m] to the axis of the base, where it was put down, counts as free: a camera on
            the robot does not see the floor round its feet. Later on only the space that the base has been in does.
    """

    search: GridSearchConfig = field(
        default_factory=lambda: GridSearchConfig(
            through_blocked=30.0,
            through_unknown=2.0,
            through_guessed=3.0,
            workspace=WorkspaceConfig(unknown_confidence=0.5),
        )
    )
    chomp: ChompConfig = field(
        # Plans that succeed take 10 to 30 iterations; the others end as the searched route, and should do so soon.
        default_factory=lambda: ChompConfig(
            eps=0.35, descent=DescentConfig(polish=20), max_iterations=60, max_tightenings=1, restarts=0
        )
    )
    num_waypoints: int = 40
    spacing: float = 0.1
    margin: float = 0.05
    clearance_change: float = 0.05
    off_path: float = 0.25
    looks: int = 3
    looks_came: int = 8
    memory: float = 30.0
    stand_off: float = 1.0
    wary: float = 0.03
    room: float = 0.5

    def __post_init__(self) -> None:
        refuse_nan(self)
        positive = (self.spacing, self.clearance_change, self.off_path, self.memory, self.room)
        good = (
            all(value > 0 for value in positive)
            and self.stand_off >= 0
            and self.wary >= 0
            and self.num_waypoints >= 3
            and min(self.looks, self.looks_came) >= 1
            and self.margin >= self.search.least_margin
        )
        if not good:
            raise ConfigError(
                "BasePlannerConfig: spacing, clearance_change, off_path, memory and room must be positive, stand_off "
                "and wary not negative, num_waypoints at least 3, looks and looks_came at least 1 and margin at least "
                f"search.least_margin, got {self}."
            )


@dataclass(frozen=True, eq=False)
class BasePlan:
    """A plan of the base.

    Args:
        result: the path with its verdict.
        reaches_goal: whether it leads to the goal, or only nearer to it.
        dead_end: whether it leads nowhere, because the robot stands where it ends already.
        onward: (m, 2) how it would go on through unknown or blocked space [m]: what is to be looked at. Empty if it
            reaches the goal or no way leads there.
        came: whether something came into the way, where it was free before.
        blocker: (2,) where that is [m], as far as the map knows of what came.
    """

    result: PlanResult
    reaches_goal: bool
    dead_end: bool
    onward: Float[Tensor, "m 2"]
    came: bool
    blocker: Float[Tensor, "2"] | None

    @property
    def usable(self) -> bool:
        """True if it is worth driving."""
        return self.result.success and not self.dead_end

    @property
    def reason(self) -> str:
        """Why it is not."""
        if self.dead_end:
            return "something came into the way" if self.came else "no way leads nearer to the goal"
        return f"{self.result.status.value}: {self.result.message}"


# Something has come where so many positions, into what is blocked now, were free: the edges of walls shift with every
# image.
DEEP = 4
# From the side of somebody that is seen to his middle [m].
HALF_AS_WIDE = 0.2
# A way leads on if the base gets that much farther on it [m].
FREE = 0.5


class BasePlanner:
    """Plans to a goal, or as near to it as the map allows.

    Where no free way leads to the goal the plan goes to where the map may be wrong, such as a doorway into a room not
    seen yet; places that stay blocked when looked at are remembered and not tried again.

    Args:
        body: the spheres to keep clear, with q = (x, y).
        config: see `BasePlannerConfig`.
        seed: of the optimiser's perturbation.
    """

    def __init__(self, body: SphereRobot, config: BasePlannerConfig | None = None, seed: int = 0) -> None:
        self.body, self.config, self.seed = body, config or BasePlannerConfig(), seed
        self._looks = VainLooks(
            self.config.memory, (self.config.looks, self.config.looks_came), self.config.stand_off
        )
        self._once_free = OnceFree(self.config.search.spacing)
        self._trodden, self._last = Trodden(), torch.full((2,), torch.inf)
        centres, _ = body.spheres(torch.zeros(2))
        self._reach = float(centres[:, :2].norm(dim=1).max()) + 0.5 * self.config.search.spacing

    def forget(self) -> None:
        """Forget the dead ends, for another goal."""
        self._looks.forget()

    def stood(self, position: Float[Tensor, "2"]) -> None:
        """Take note that the base has been at a position [m]: space there is free, whether or not it was seen."""
        if (self._last - position).norm() > 0.5 * self.config.search.spacing:
            put_down = not bool(torch.isfinite(self._last).all())
            self._trodden.add(position.double().numpy(), self.config.room if put_down else self._reach)
            self._last = position

    @one_thread
    def plan(
        self,
        start: Float[Tensor, "2"],
        goal: Float[Tensor, "2"],
        sdf: DistanceField,
        route: Route | None = None,
        now: float = 0.0,
    ) -> BasePlan:
        """Plan from start to goal [m], through seen space; a dead end is remembered.

        Args:
            start: where the base stands [m].
            goal: where it is to go [m].
            sdf: the map.
            route: the way from start to goal, if it was searched already.
            now: time [s], to know how old a dead end is.
        """
        self.stood(start)
        route = route or self.route(start, goal, sdf, now)
        explored = self._explored(sdf)
        blocker = self._blocker(route, explored)
        came = blocker is not None or self._has_come(route, now)
        if route.entry is not None:
            route = self._to_wait_at(route, blocker, now) if came else self._to_look_from(route, now)
        result = self._optimised(route, explored)
        dead_end = result.success and not route.reaches_goal and self._leads_nowhere(route, goal)
        if dead_end and route.entry is not None:
            self._looks.add(now, route.entry, came)
        return BasePlan(result, route.reaches_goal, dead_end, route.onward, came, blocker)

    def route(
        self, start: Float[Tensor, "2"], goal: Float[Tensor, "2"], sdf: DistanceField, now: float = 0.0
    ) -> Route:
        """The way to the goal, past what stayed blocked when it was looked at."""
        explored = self._explored(sdf)

        def passing(places: Tensor, deepest: Tensor) -> Tensor:
            return self._passing(explored, places, deepest)

        search = self.config.search
        closed = self._looks.closed(now, search.closed_radius)
        route = grid_search(self.body, explored, start, goal, search, closed, passing)
        if route.entry is None and not route.reaches_goal and self._looks.any_came(now):
            # There is no other way than the one that somebody stood in for long: it is waited for again.
            closed = self._looks.closed(now, search.closed_radius, for_good=True)
            route = grid_search(self.body, explored, start, goal, search, closed, passing)
        self._once_free.add(route.grid.free)
        return route

    def leads_on(self, route: Route, sdf: DistanceField, now: float = 0.0) -> bool:
        """Whether a way that was blocked by what came is free by now [s], all of it or the next part."""
        if route.entry is None:
            return route.reaches_goal
        path = self._to_wait_at(route, self._blocker(route, self._explored(sdf)), now).path
        return float((path[-1] - path[0]).norm()) > FREE

    def still_good(self, plan: PlanResult, position: Float[Tensor, "2"], sdf: DistanceField) -> bool:
        """Whether what is left of a plan from where the base stands [m] keeps its clearance on a new map."""
        waypoints = plan.trajectory.waypoints
        nearest = int((waypoints - position).norm(dim=1).argmin())
        if _gap(waypoints[max(0, nearest - 1) : nearest + 2], position) > self.config.off_path:
            return False
        left = Trajectory.through(torch.cat([position[None], waypoints[nearest + 1 :]]))
        clearance = check(self.body, left, self._explored(sdf), self.config.chomp.validation).clearance
        return clearance >= min(self.config.margin, plan.clearance) - self.config.clearance_change

    def _explored(self, sdf: DistanceField) -> DistanceField:
        """The field with what it has not seen as unknown; the field itself where it does not tell."""
        if isinstance(sdf, ObservingField | ConfidentField):
            return ExploredField(sdf, self._trodden, self.config.wary)
        return sdf

    def _workspace(self, sdf: DistanceField) -> Workspace:
        """Clearances and unknown space by the rules of the search."""
        return Workspace(self.body, sdf, eps=1.0, config=self.config.search.workspace)

    def _optimised(self, route: Route, sdf: DistanceField) -> PlanResult:
        """CHOMP from the route, or the route itself where CHOMP fails or leaves seen space.

        The clearance asked for is what the route has, at most the margin; the cost still seeks more.
        """
        config, began = self.config, time.perf_counter()
        path = Trajectory.through(route.path)
        found = check(self.body, path, sdf, config.chomp.validation)
        validation = replace(config.chomp.validation, margin=min(config.margin, found.clearance - 0.005))
        start = check(self.body, Trajectory.through(route.path[:1]), sdf, config.chomp.validation)
        # Where the robot stands too close already, only the search knows where it may be as close again.
        if start.clearance >= config.search.least_margin:
            chomp = Chomp(self.body, replace(config.chomp, validation=validation), self.seed)
            guess = Trajectory.through(route.path, self._waypoints(route)) if len(path) > 1 else path
            result = chomp.optimise(guess, sdf)
            if result.success and self._stays_in_seen_space(result.trajectory, sdf):
                return result
        verdict = check(self.body, path, sdf, validation)
        message = f"the searched route: {verdict.message}"
        seconds = time.perf_counter() - began
        return PlanResult(path, verdict.status, message, verdict.clearance, (), 0, seconds)

    def _waypoints(self, route: Route) -> int:
        """How many waypoints a plan along a route has."""
        steps = math.ceil(path_length(route.path.numpy()) / self.config.spacing)
        return min(self.config.num_waypoints, max(MIN_WAYPOINTS, steps + 1))

    def _stays_in_seen_space(self, path: Trajectory, sdf: DistanceField) -> bool:
        """Whether a path enters no unknown space, by the rules of the search."""
        workspace = self._workspace(sdf)
        centres, _ = self.body.spheres(Trajectory.through(path.waypoints, 4 * len(path)).waypoints)
        unknown = workspace.unknown(centres)
        return unknown is None or not bool(unknown.any())

    def _leads_nowhere(self, route: Route, goal: Float[Tensor, "2"]) -> bool:
        """Whether the robot already stands where the route ends, or would only circle a walled-in goal."""
        if route.entry is not None:
            return float((route.path[-1] - route.path[0]).norm()) < 2 * self.config.search.spacing
        gaps = (route.path - goal).norm(dim=1)
        return float(gaps[0] - gaps[-1]) < self.config.search.spacing

    def _to_look_from(self, route: Route, now: float) -> Route:
        """The part of a route that leads to where the space that blocks it is best looked at.

        From close by, since most of what is unknown shows itself on the way there; but the last time from `stand_off`,
        for close to the robot its camera sees nothing.
        """
        assert route.entry is not None
        if self._looks.at(route.entry, now) < self.config.looks - 1:
            return route
        if float((route.path[0] - route.entry).norm()) < self.config.stand_off:
            back = route.grid.way_back(route.path[0], route.entry, self.config.stand_off)
            return replace(route, path=back)
        return _until(route, self.config.stand_off)

    def _to_wait_at(self, route: Route, blocker: Float[Tensor, "2"] | None, now: float) -> Route:
        """The part of a route that leads to where it waits for what came into the way.

        It stands off from the first, and where it does not stand in the way of what came; but it backs off only after a
        while: what came may walk on at once, and who backs off has to turn away and back again.
        """
        somebody = blocker
        if blocker is not None:
            off = blocker - route.path[0]
            somebody = blocker + HALF_AS_WIDE / off.norm().clamp_min(1e-6) * off
        if self._looks.makes_room(route, somebody, now):
            return replace(route, path=self._looks.out_of_the_way(route, somebody))
        near = _until(route, self.config.stand_off)
        return replace(near, path=self._looks.not_in_the_way(near, somebody))

    def _passing(
        self, sdf: DistanceField, places: Float[Tensor, "m 2"], deepest: Float[Tensor, "m 3"]
    ) -> Bool[Tensor, " m"]:
        """Which places are blocked by nothing but what came, as far as the field knows of that."""
        if not isinstance(sdf, ExploredField):
            return torch.zeros(len(places), dtype=torch.bool)
        out = sdf.by_what_came(deepest)
        if out.any():
            workspace = self._workspace(sdf)
            centres, radii = self.body.spheres(places[out])
            cut = workspace.clearance(centres, radii) < self.config.search.least_margin
            alone = ~cut
            alone[cut] = sdf.by_what_came(centres[cut])
            out[out.clone()] = alone.all(dim=1)
        return out

    def _has_come(self, route: Route, now: float) -> bool:
        """Whether what blocks the way has come: space was free there."""
        if route.entry is None:
            return not route.reaches_goal and self._looks.any_came(now)
        return bool(self._once_free.were(route.onward[:DEEP]).all())

    def _blocker(self, route: Route, sdf: DistanceField) -> Float[Tensor, "2"] | None:
        """Where what blocks the way is [m], if the field knows that it came."""
        if route.entry is None or not isinstance(sdf, ExploredField):
            return None
        workspace = self._workspace(sdf)
        centres, radii = self.body.spheres(route.entry)
        clearance = workspace.clearance(centres, radii)
        deepest = centres[clearance.argmin()]
        if clearance.min() >= self.config.search.least_margin or not bool(sdf.by_what_came(deepest)):
            return None
        return sdf.nearest_surface(deepest)[:2]


def _until(route: Route, off: float) -> Route:
    """A route up to where what blocks it is `off` [m] away; its first position at least."""
    assert route.entry is not None
    near = (route.path - route.entry).norm(dim=1) < off
    end = max(1, int(near.float().argmax())) if near.any() else len(route.path)
    return replace(route, path=route.path[:end])


def _gap(path: Float[Tensor, "k 2"], position: Float[Tensor, "2"]) -> float:
    """Distance [m] of a position to a polyline."""
    if len(path) == 1:
        return float((path[0] - position).norm())
    start, step = path[:-1], path.diff(dim=0)
    share = ((position - start) * step).sum(dim=1) / step.square().sum(dim=1).clamp_min(1e-12)
    return float((start + share.clamp(0, 1)[:, None] * step - position).norm(dim=1).min())
