"""Where a driving robot looks: along its path, and nodding, since no camera sees from its feet to its head at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from planning.drive import MobileRobot
from planning.errors import ConfigError

T = TypeVar("T")

# A path shorter than this [m] is at its end: what counts is what lies ahead.
AT_THE_END = 0.5
# The camera looks at what is within this angle of the way the base faces [rad].
FACING = 0.3


@dataclass(frozen=True)
class GazeConfig:
    """What the camera looks at.

    Args:
        ahead: distance along the path [m].
        heights: heights [m] there between which it nods, to see both what stands on the floor and what hangs as high as
            the robot's head.
        near: distance [m] at which it looks at the floor, too, while the base turns on the spot: to see where it could
            drive off.
        nod: time [s] at each of them.
    """

    ahead: float = 1.5
    heights: tuple[float, ...] = (0.0, 1.1)
    near: float = 0.7
    nod: float = 0.5

    def __post_init__(self) -> None:
        if not self.heights or not min(self.ahead, self.near, self.nod) > 0:
            raise ConfigError(
                "GazeConfig: heights must not be empty, and ahead, near and nod must be positive, got "
                f"heights {self.heights}, ahead {self.ahead:g} m, near {self.near:g} m and nod {self.nod:g} s."
            )


class Gaze:
    """Turns the camera of a robot.

    Args:
        robot: whose camera.
        config: see `GazeConfig`.
    """

    def __init__(self, robot: MobileRobot, config: GazeConfig) -> None:
        self.robot, self.config = robot, config

    def along(self, path: Float[ndarray, "n 2"], state: Float[ndarray, "3"]) -> None:
        """Look at where a path [m] will lead from a base at `state` (x, y [m], yaw [rad]); ahead where it ends."""
        nearest = int(np.linalg.norm(path - state[:2], axis=1).argmin())
        way = np.r_[0.0, np.linalg.norm(np.diff(path[nearest:], axis=0), axis=1).cumsum()]
        if way[-1] < AT_THE_END:
            self.towards(state[:2], float(state[2]))
            return
        place = path[nearest + int(np.searchsorted(way, self.config.ahead).clip(0, len(way) - 1))]
        self.robot.look_at(np.array([*place, self._nod(self.config.heights)]))

    def towards(self, position: Float[ndarray, "2"], heading: float) -> None:
        """Look from a position [m] in a direction [rad], at the floor near by, too."""
        far = [(self.config.ahead, height) for height in self.config.heights]
        distance, height = self._nod([(self.config.near, 0.0), *far])
        place = position + distance * np.array([math.cos(heading), math.sin(heading)])
        self.robot.look_at(np.array([*place, height]))

    def onward(
        self, way: Float[ndarray, "n 2"], state: Float[ndarray, "3"], rate: float
    ) -> tuple[float, bool]:
        """Look along where a way [m] would go on, if there is one, and else ahead while the base turns.

        Args:
            way: positions; those nearer than `near` do not count.
            state: x, y [m], yaw [rad] of the base.
            rate: of turning [rad/s].

        Returns:
            How fast to turn [rad/s], and whether the camera looks there already; around it always does.
        """
        far = way[np.linalg.norm(way - state[:2], axis=1) > self.config.near]
        if len(far) == 0:
            self.towards(state[:2], float(state[2]))
            return rate, True
        away = far[0] - state[:2]
        heading = math.atan2(away[1], away[0])
        error = math.remainder(heading - state[2], 2 * math.pi)
        self.towards(state[:2], heading)
        return float(np.clip(error, -rate, rate)), abs(error) <= FACING

    def _nod(self, between: Sequence[T]) -> T:
        """One of the things to look at in turn."""
        return between[int(self.robot.time / self.config.nod) % len(between)]
