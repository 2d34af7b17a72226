"""What somebody at the viewer asks of the program that is watched: to pause, to go one step, to go elsewhere."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

POLLED_EVERY = 0.03
"""[s]"""


class Controls:
    """Set by the viewer, polled by the loop between its steps; no call of it ever waits, but for `hold`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._paused = False
        self._steps = 0
        self._goal: np.ndarray | None = None

    @property
    def paused(self) -> bool:
        """Whether the loop is asked to stand still."""
        return self._paused

    def pause(self) -> None:
        """Stand still from the next step on."""
        self._paused = True

    def play(self) -> None:
        """Go on."""
        with self._lock:
            self._paused, self._steps = False, 0

    def step(self) -> None:
        """Make one step, and stand still again."""
        with self._lock:
            self._paused = True
            self._steps += 1

    def may_go(self) -> bool:
        """Whether the next step may be made now; uses up a step that was asked for."""
        with self._lock:
            if not self._paused:
                return True
            self._steps, may = max(0, self._steps - 1), self._steps > 0
            return may

    def hold(self, still_wanted: Callable[[], bool]) -> bool:
        """Wait until the next step may be made, as long as `still_wanted`; returns whether it waited."""
        if self.may_go():
            return False
        while still_wanted() and not self.may_go():
            time.sleep(POLLED_EVERY)
        return True

    def move_goal(self, goal: Float[np.ndarray, "d"]) -> None:
        """Ask for another goal: x, y or x, y, z [m]."""
        with self._lock:
            self._goal = np.array(goal, dtype=float)

    def take_goal(self) -> Float[np.ndarray, "d"] | None:
        """The goal asked for since the last call, if any."""
        with self._lock:
            goal, self._goal = self._goal, None
            return goal
