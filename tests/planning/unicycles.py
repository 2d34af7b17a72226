"""A robot and a map for tests of the closed loop: exact kinematics, and a map that is told what to know."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from tests.planning.fields import AutogradField
from tests.planning.robots import Disc


class Unicycle:
    """Drives exactly as commanded, and remembers where it was.

    Args:
        state: x, y [m], yaw [rad].
        frame: gives what is observed at a time [s].
    """

    def __init__(
        self,
        state: tuple[float, float, float] = (0.0, 0.0, 0.0),
        frame: Callable[[float], object] = lambda time: "frame",
    ) -> None:
        self.time = 0.0
        self.state = np.array(state)
        self.frame = frame
        self.states = [self.state.copy()]
        self.commands: list[tuple[float, float]] = []
        self.looked_at: list[np.ndarray] = []

    def base_state(self) -> np.ndarray:
        return self.state.copy()

    def observe(self) -> object:
        return self.frame(self.time)

    def look_at(self, point: np.ndarray) -> None:
        self.looked_at.append(point)

    def drive(self, v: float, omega: float, duration: float) -> None:
        self.commands.append((v, omega))
        steps = max(1, round(duration / 0.01))
        for _ in range(steps):
            yaw = self.state[2] + 0.5 * omega * duration / steps
            self.state = self.state + duration / steps * np.array(
                [v * math.cos(yaw), v * math.sin(yaw), omega]
            )
            self.states.append(self.state)
        self.time += duration

    def clearance(self, body: Disc, field: AutogradField) -> float:
        """Least true clearance [m] of all places the robot was at."""
        positions = torch.tensor(np.array(self.states)[:, :2], dtype=torch.float32)
        centres, radii = body.spheres(positions)
        return float((field.distance(centres) - radii).min())


class TaughtMap:
    """A map that knows the field it is given; without a frame it knows nothing and has no field.

    Args:
        field: what it knows, or a function that says so whenever it is asked.
    """

    def __init__(self, field: AutogradField | Callable[[], AutogradField]) -> None:
        self._field = field
        self.frames = 0
        self.steps = 0
        self.asked = 0.0

    def integrate(self, frame: object) -> None:
        if frame == "bad":
            raise ValueError("a bad frame")
        self.frames += 1

    def step(self) -> float:
        assert self.frames, "a map without frames cannot be trained"
        self.steps += 1
        return 0.0

    def run_for(self, cpu_seconds: float) -> int:
        self.asked += cpu_seconds
        self.step()
        return 1

    def snapshot(self) -> AutogradField:
        assert self.frames, "a map without frames has no field"
        return self._field() if callable(self._field) else self._field
