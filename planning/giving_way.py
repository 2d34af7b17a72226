"""Letting pass what crosses the way, rather than turning off at once to a way that is much longer."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from planning.result import PlanResult


class GivingWay:
    """A plan that something has come into is waited for, for a while, if the way round is a detour.

    Args:
        patience: longest wait [s].
        detour: a way round that is longer by no more than this [m] is taken at once.
    """

    def __init__(self, patience: float, detour: float) -> None:
        self.patience, self.detour = patience, detour
        self.end()

    def end(self) -> None:
        """Wait for nothing any more."""
        self.plan: PlanResult | None = None
        self._since = math.inf

    def waits(self, plan: PlanResult, left: float, way_round: float, now: float) -> bool:
        """Whether to stand and let pass; `plan` is then what is waited for.

        Args:
            plan: what cannot be followed at the moment.
            left: how much of the way is left by it [m].
            way_round: how long the way is that can be followed [m].
            now: [s].
        """
        since = min(self._since, now)
        if way_round - left <= self.detour or now - since >= self.patience:
            self.end()
            return False
        self.plan, self._since = plan, since
        return True


def length_left(path: Float[ndarray, "n 2"], position: Float[ndarray, "2"]) -> float:
    """Length of a path [m] from the waypoint nearest to a position [m] on."""
    nearest = int(np.linalg.norm(path - position, axis=1).argmin())
    return path_length(path[nearest:])


def path_length(path: Float[ndarray, "n 2"]) -> float:
    """Length of a polyline [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
