"""What a drive needs of a mobile robot, and how it can end."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from numpy import ndarray

MOST_EVENTS = 100


@runtime_checkable
class MobileRobot(Protocol):
    """The robot and its world, real or simulated: it senses, drives, and lets time pass."""

    @property
    def time(self) -> float:
        """Now [s]."""
        ...

    def base_state(self) -> Float[ndarray, "3"]:
        """x, y [m] and yaw [rad] of the base."""
        ...

    def observe(self) -> Any | None:
        """The newest depth frame, without the robot's own body; None if there is no new one."""
        ...

    def look_at(self, point: Float[ndarray, "3"]) -> None:
        """Turn the camera towards a world point [m] as far as it goes."""
        ...

    def drive(self, v: float, omega: float, duration: float) -> None:
        """Drive at v [m/s] and omega [rad/s] for some time [s]."""
        ...


class DriveStatus(enum.Enum):
    """How a drive ended."""

    REACHED = "reached"
    UNREACHABLE = "unreachable"
    TIME_LIMIT = "time limit"


@dataclass
class DriveReport:
    """What happened on a drive. Times in seconds, lengths in metres.

    `slowed`, `stopped` and `blind` count the control periods in which the collision monitor changed the command, and
    `events` says what interrupted the drive and when: at most `MOST_EVENTS` lines.
    """

    status: DriveStatus = DriveStatus.TIME_LIMIT
    message: str = ""
    duration: float = 0.0
    path_length: float = 0.0
    goal_distance: float = math.inf
    rounds: int = 0
    plans: int = 0
    failed_plans: int = 0
    frames: int = 0
    frames_refused: int = 0
    mapping_seconds: float = 0.0
    planning_seconds: float = 0.0
    slowest_plan: float = 0.0
    slowed: int = 0
    stopped: int = 0
    blind: int = 0
    events: list[str] = field(default_factory=list)

    @property
    def success(self) -> bool:
        """True if the goal was reached."""
        return self.status is DriveStatus.REACHED

    def joined(self, later: DriveReport) -> DriveReport:
        """This drive and a later one as one: it ended as the later one did."""
        sums = (
            "duration", "path_length", "rounds", "plans", "failed_plans", "frames", "frames_refused",
            "mapping_seconds", "planning_seconds", "slowed", "stopped", "blind",
        )  # fmt: skip
        events = [*self.events, *later.events][:MOST_EVENTS]
        slowest = max(self.slowest_plan, later.slowest_plan)
        added = {name: getattr(self, name) + getattr(later, name) for name in sums}
        return replace(later, slowest_plan=slowest, events=events, **added)

    def note(self, time: float, event: str) -> None:
        """Add an event at a time [s] of the drive."""
        if len(self.events) < MOST_EVENTS:
            self.events.append(f"{time:.1f} s: {event}")
