"""What mapping and planning cost: measured CPU time, or fixed amounts for runs that must repeat exactly."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

from jaxtyping import Float
from numpy import ndarray

from planning.errors import ConfigError

T = TypeVar("T")


@runtime_checkable
class OnlineMap(Protocol):
    """A map that learns from frames while the robot moves."""

    def integrate(self, frame: object) -> None:
        """Take in a new frame; ValueError if it cannot be used."""
        ...

    def step(self) -> float:
        """Train once."""
        ...

    def run_for(self, cpu_seconds: float) -> int:
        """Train for some CPU time [s]; returns the number of steps."""
        ...


@runtime_checkable
class FootprintMap(OnlineMap, Protocol):
    """A map that can be told where the robot is."""

    def clear_footprint(self, centres: Float[ndarray, "s 3"], radii: Float[ndarray, "s"]) -> None:
        """Space inside these spheres [m] is free."""
        ...


@runtime_checkable
class Clock(Protocol):
    """Says how long the robot's computer took; the world moves on by that."""

    def train(self, mapper: OnlineMap) -> float:
        """Train the map once round the loop; returns the time it took [s]."""
        ...

    def charge(self, work: Callable[[], T]) -> tuple[T, float]:
        """Do some work; returns its result and the time it took [s]."""
        ...


@dataclass(frozen=True)
class MeasuredClock:
    """Everything costs the CPU time it takes on this machine, all threads together.

    Args:
        training: CPU time given to the map in each round [s].
        timer: CPU time used so far [s], where something in this process is not to be charged.
    """

    training: float = 0.25
    timer: Callable[[], float] = time.process_time

    def __post_init__(self) -> None:
        if self.training <= 0:
            raise ConfigError(f"MeasuredClock: training must be a positive time, got {self.training:g} s.")

    def train(self, mapper: OnlineMap) -> float:
        """Train for the configured CPU time."""
        return self.charge(lambda: mapper.run_for(self.training))[1]

    def charge(self, work: Callable[[], T]) -> tuple[T, float]:
        """Do the work and measure it."""
        before = self.timer()
        result = work()
        return result, self.timer() - before


@dataclass(frozen=True)
class FixedClock:
    """Every round costs the same, however fast the machine is: runs repeat exactly.

    Args:
        steps: training steps in each round.
        training: time charged for them [s].
        planning: time charged for anything else [s].
    """

    steps: int = 10
    training: float = 0.25
    planning: float = 0.15

    def __post_init__(self) -> None:
        if self.steps < 1 or min(self.training, self.planning) < 0:
            raise ConfigError(f"FixedClock: steps must be at least 1 and times not negative, got {self}.")

    def train(self, mapper: OnlineMap) -> float:
        """Train for the configured number of steps."""
        for _ in range(self.steps):
            mapper.step()
        return self.training

    def charge(self, work: Callable[[], T]) -> tuple[T, float]:
        """Do the work and charge the configured time."""
        return work(), self.planning
