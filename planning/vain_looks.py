"""Where a base stood before blocked space and looked in vain: how often, how far off, and when to try elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from planning.grid_search import Route

# Who came into the way and has stayed for so many looks may be shut in by the robot. If he has no more room [m^2] than
# that without coming nearer to it than this [m], it goes out of his way, so far [m], for some time [s]; to where he has
# more room [m^2] than a room with the passage to it, which is no way out.
WAITED, SHUT_IN, NEARER, OUT_OF_WAY, MAKES_ROOM, WAY_OUT = 4, 6.0, 1.0, 1.1, 20.0, 12.0
# Who stays for so many looks may be shut in by what the map does not know of: it goes so far back [m], whatever room
# there seems to be.
LONG, FAR_BACK = 10, 3.0

# Of a path every so many positions are tried.
STRIDE = 3


class _Look(NamedTuple):
    """The base stood and looked at blocked space in vain.

    Args:
        when: [s].
        place: where blocked space would have been entered, (2,) [m].
        came: whether it was free before.
    """

    when: float
    place: Tensor
    came: bool


class VainLooks:
    """Remembers them for a while, for the world changes.

    Args:
        memory: how long [s].
        looks: so often it looks before blocked space counts as blocked; and the same where something came.
        near: looks so close [m] together were at the same place.
    """

    def __init__(self, memory: float, looks: tuple[int, int], near: float) -> None:
        self.memory, self.looks, self.near = memory, looks, near
        self.forget()

    def forget(self) -> None:
        """Nothing was looked at."""
        self._looks: list[_Look] = []
        self._withdrew: _Look | None = None
        self._far_back = False

    def add(self, now: float, place: Float[Tensor, "2"], came: bool) -> None:
        """The base looks in vain, at a time [s], at where it would enter blocked space [m], perhaps by what came."""
        self._looks.append(_Look(now, place, came))

    def at(self, place: Float[Tensor, "2"], now: float, came: bool = False) -> int:
        """How often it did at a place [m]; if asked, of those only at what came there."""
        return sum(self._near(look, place) and look.came >= came for look in self._recent(now))

    def any_came(self, now: float) -> bool:
        """Whether any was at what came."""
        return any(look.came for look in self._recent(now))

    def closed(self, now: float, radius: float, for_good: bool = False) -> Float[Tensor, "c 2"] | None:
        """Entries [m] into blocked space that stayed blocked however often the robot looked within a radius [m].

        Args:
            now: [s].
            radius: [m].
            for_good: only those that nothing has come into, which may go again.
        """
        looks = [look for look in self._recent(now) if not (for_good and look.came)]
        if not looks:
            return None
        entries = torch.stack([look.place for look in looks])
        visits = (torch.cdist(entries, entries) <= radius).sum(dim=1)
        return entries[visits >= torch.tensor([self.looks[look.came] for look in looks])]

    def makes_room(self, route: Route, somebody: Float[Tensor, "2"] | None, now: float) -> bool:
        """Whether the base is to go out of the way of what came into its own: once, where that is shut in by it.

        Args:
            route: the way.
            somebody: where that is [m]; None if only the way is known that it blocks.
            now: [s].
        """
        assert route.entry is not None
        if self._withdrew is None or now - self._withdrew.when >= self.memory:
            looks = self.at(route.entry, now, came=True)
            long = looks >= LONG
            if looks < WAITED or not (long or _shuts_in(route, route.path[0], somebody, NEARER)):
                return False
            self._far_back = long
            self._withdrew = _Look(now, route.entry, True)
        return self._near(self._withdrew, route.entry) and now - self._withdrew.when < MAKES_ROOM

    def out_of_the_way(self, route: Route, somebody: Float[Tensor, "2"] | None) -> Float[Tensor, "k 2"]:
        """The path [m] to the nearest place that leaves him a way out; the position itself where there is none.

        Far back, whatever room there seems to be, if that is why the base `makes_room`.
        """
        assert route.entry is not None
        if self._far_back:
            return route.grid.way_back(route.path[0], route.entry, FAR_BACK)
        places = route.onward if somebody is None else somebody[None]
        return route.grid.nearest_with_room(route.path[0], places, OUT_OF_WAY, WAY_OUT)

    def not_in_the_way(self, route: Route, somebody: Float[Tensor, "2"] | None) -> Float[Tensor, "k 2"]:
        """The path of a route [m] up to the last place where the base shuts in nobody, its first position at least."""
        for end in range(len(route.path), 1, -STRIDE):
            if not _shuts_in(route, route.path[end - 1], somebody, OUT_OF_WAY):
                return route.path[:end]
        return route.path[:1]

    def _recent(self, now: float) -> list[_Look]:
        self._looks = [look for look in self._looks if now - look.when < self.memory]
        return self._looks

    def _near(self, look: _Look, place: Float[Tensor, "2"]) -> bool:
        return bool((look.place - place).norm() <= self.near)


def _shuts_in(
    route: Route, robot: Float[Tensor, "2"], somebody: Float[Tensor, "2"] | None, nearer: float
) -> bool:
    """Whether somebody has no way out but one nearer to a robot than some distance [m], or than he is already."""
    if somebody is None:
        return route.grid.room(route.onward, robot, nearer) <= SHUT_IN
    away = float((somebody - robot).norm()) - route.grid.spacing
    return route.grid.room(somebody[None], robot, min(nearer, away)) <= SHUT_IN
