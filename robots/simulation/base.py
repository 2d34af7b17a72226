"""Differential drive: commanded forward speed and turning rate, saturated as a real base saturates them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robots.errors import RobotError
from robots.numbers import refuse_nan


@dataclass(frozen=True)
class DriveConfig:
    """Limits of a differential-drive base; the defaults are a careful indoor service robot's."""

    max_speed: float = 0.7
    """Forward or backward [m/s]."""
    max_turn_rate: float = 1.0
    """[rad/s]."""
    max_acceleration: float = 1.0
    """[m/s^2]."""
    max_turn_acceleration: float = 2.0
    """[rad/s^2]."""
    max_force: float = 300.0
    """Push of the drive along x and y [N]: about 70 kg at the acceleration limit, with reserve."""
    max_torque: float = 150.0
    """Torque of the drive about the vertical [N m]."""

    def __post_init__(self) -> None:
        refuse_nan(self)
        for name, value in vars(self).items():
            if not value > 0:
                raise RobotError(f"DriveConfig.{name} must be positive, got {value}")


class DifferentialDrive:
    """Follows a commanded (v, omega) within speed and acceleration limits."""

    def __init__(self, config: DriveConfig | None = None):
        self.config = config or DriveConfig()
        self.v = 0.0
        """Forward speed now asked of the base [m/s]."""
        self.omega = 0.0
        """Turning rate now asked of the base [rad/s]."""
        self._command = (0.0, 0.0)

    def command(self, v: float | int, omega: float | int) -> None:
        """Set the wanted forward speed [m/s] and turning rate [rad/s]; values over the limits are clipped.

        Raises:
            RobotError: if a value is not finite.
        """
        if not np.isfinite([v, omega]).all():
            raise RobotError(f"base command must be finite, got v = {v}, omega = {omega}")
        c = self.config
        self._command = (
            float(np.clip(v, -c.max_speed, c.max_speed)),
            float(np.clip(omega, -c.max_turn_rate, c.max_turn_rate)),
        )

    def advance(self, dt: float) -> tuple[float, float]:
        """Move the asked speeds towards the command over `dt` [s] and return (v, omega)."""
        c = self.config
        v, omega = self._command
        self.v += float(np.clip(v - self.v, -c.max_acceleration * dt, c.max_acceleration * dt))
        turn = c.max_turn_acceleration * dt
        self.omega += float(np.clip(omega - self.omega, -turn, turn))
        return self.v, self.omega


def planar_velocity(v: float, omega: float, yaw: float, dt: float = 0.0) -> tuple[float, float, float]:
    """World velocity (x [m/s], y [m/s], yaw [rad/s]) of a base at heading `yaw` [rad] driven with (v, omega).

    With `dt` [s] the direction is that of the chord of the arc driven in that time, so that integrating the
    constant velocity over `dt` ends on the arc.
    """
    heading = yaw + 0.5 * omega * dt
    return v * float(np.cos(heading)), v * float(np.sin(heading)), omega
