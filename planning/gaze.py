"""Where a driving robot looks: along its path, nodding, since no camera sees from its feet to its head at once.

In between it looks at those who stand about, see `planning.bystanders`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from planning.drive import MobileRobot
from planning.errors import ConfigError
from planning.numbers import refuse_nan

# A path shorter than this [m] is at its end: what counts is what lies ahead.
AT_THE_END = 0.5
# The camera looks at what is within this angle of the way the base faces [rad].
FACING = 0.3
# The neck turns so far [rad] that what is beside the robot comes into view, at least at the edge.
NECK = 1.6
# Those who stand about are looked at in this height [m], as if they were at least so far away [m]: a look down at the
# feet of somebody close by does not show whether he is still there.
CHEST, CLOSE = 1.0, 1.0


@dataclass(frozen=True)
class GazeConfig:
    """What the camera looks at.

    Args:
        looks: distances along the path and heights there [m] between which it nods: at the floor that comes next, where
            it also sees who steps into the way from beside, and at what hangs as high as the robot's head.
        near: distance [m] at which it looks at the floor, too, while the base turns on the spot: to see where it could
            drive off.
        nod: time [s] of each look.
    """

    looks: tuple[tuple[float, float], ...] = ((1.0, 0.0), (1.5, 1.1))
    near: float = 0.7
    nod: float = 0.5

    def __post_init__(self) -> None:
        refuse_nan(self)
        positive = [self.near, self.nod, *(distance for distance, _ in self.looks)]
        if not self.looks or not all(value > 0 for value in positive):
            raise ConfigError(
                "GazeConfig: looks must not be empty, and their distances, near and nod must be positive, got "
                f"looks {self.looks}, near {self.near:g} m and nod {self.nod:g} s."
            )


class Gaze:
    """Turns the camera of a robot.

    Args:
        robot: whose camera.
        config: see `GazeConfig`.
    """

    def __init__(self, robot: MobileRobot, config: GazeConfig) -> None:
        self.robot, self.config = robot, config
        self.bystanders: Float[ndarray, "n 2"] = np.empty((0, 2))
        """Places [m] to look at in turn between the other looks."""

    def along(self, path: Float[ndarray, "n 2"], state: Float[ndarray, "3"]) -> None:
        """Look at where a path [m] will lead from a base at `state` (x, y [m], yaw [rad]); ahead where it ends."""
        nearest = int(np.linalg.norm(path - state[:2], axis=1).argmin())
        way = np.r_[0.0, np.linalg.norm(np.diff(path[nearest:], axis=0), axis=1).cumsum()]
        if way[-1] < AT_THE_END:
            self.towards(state, float(state[2]))
            return
        last = len(way) - 1
        looks = [
            (*path[nearest + min(int(np.searchsorted(way, distance)), last)], height)
            for distance, height in self.config.looks
        ]
        self._nod(looks, state)

    def towards(self, state: Float[ndarray, "3"], heading: float) -> None:
        """Look from a base at `state` (x, y [m], yaw [rad]) in a direction [rad], at the floor near by, too."""
        ahead = np.array([math.cos(heading), math.sin(heading)])
        looks = [
            (*(state[:2] + distance * ahead), height)
            for distance, height in ((self.config.near, 0.0), self.config.looks[-1], *self.config.looks)
        ]
        self._nod(looks, state)

    def onward(
        self, way: Float[ndarray, "n 2"], state: Float[ndarray, "3"], rate: float
    ) -> tuple[float, bool]:
        """Look along where a way [m] would go on, if there is one, and else ahead while the base turns.

        Args:
            way: positions; of those nearer than `near` only the last counts, if there are no others.
            state: x, y [m], yaw [rad] of the base.
            rate: of turning [rad/s].

        Returns:
            How fast to turn [rad/s], and whether the camera looks there already; around it always does.
        """
        if len(way) == 0:
            self.towards(state, float(state[2]))
            return rate, True
        far = np.linalg.norm(way - state[:2], axis=1) > self.config.near
        away = way[int(far.argmax()) if far.any() else -1] - state[:2]
        heading = math.atan2(away[1], away[0])
        error = math.remainder(heading - state[2], 2 * math.pi)
        self.towards(state, heading)
        return float(np.clip(error, -rate, rate)), abs(error) <= FACING

    def _nod(self, looks: Sequence[tuple[float, ...]], state: Float[ndarray, "3"]) -> None:
        """Look at one of the points [m] in turn, and after them at one of the two nearest bystanders."""
        others = [place for place in self.bystanders if self._in_reach(place, state)][:2]
        turn, step = divmod(int(self.robot.time / self.config.nod), len(looks) + bool(others))
        point = looks[step] if step < len(looks) else self._at_level(others[turn % len(others)], state)
        self.robot.look_at(np.array(point, dtype=float))

    @staticmethod
    def _at_level(place: Float[ndarray, "2"], state: Float[ndarray, "3"]) -> tuple[float, ...]:
        away = place - state[:2]
        far = max(1.0, CLOSE / max(float(np.linalg.norm(away)), 1e-6))
        return *(state[:2] + far * away), CHEST

    def _in_reach(self, place: Float[ndarray, "2"], state: Float[ndarray, "3"]) -> bool:
        away = place - state[:2]
        return abs(math.remainder(math.atan2(away[1], away[0]) - float(state[2]), 2 * math.pi)) < NECK
