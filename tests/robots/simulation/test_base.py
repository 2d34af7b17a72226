from __future__ import annotations

import numpy as np
import pytest

from robots.errors import RobotError
from robots.simulation import DifferentialDrive, DriveConfig
from robots.simulation.base import planar_velocity


def test_speed_and_acceleration_are_limited():
    config = DriveConfig(max_speed=0.5, max_turn_rate=0.8, max_acceleration=1.0, max_turn_acceleration=2.0)
    drive = DifferentialDrive(config)
    drive.command(5.0, -5.0)
    track = np.array([(0.0, 0.0), *(drive.advance(0.01) for _ in range(200))])
    assert track[-1] == pytest.approx([0.5, -0.8])
    assert (np.abs(np.diff(track, axis=0)).max(axis=0) <= np.array([0.01, 0.02]) + 1e-12).all()
    drive.command(0.0, 0.0)
    assert [drive.advance(0.01) for _ in range(60)][-1] == pytest.approx((0.0, 0.0))


def test_integrated_velocity_ends_on_the_arc():
    v, omega, dt, yaw = 0.5, 0.9, 0.1, 0.3
    position = np.zeros(2)
    for _ in range(20):
        vx, vy, turn = planar_velocity(v, omega, yaw, dt)
        position += np.array([vx, vy]) * dt
        yaw += turn * dt
    radius, end = v / omega, 0.3 + omega * 2.0
    exact = radius * np.array([np.sin(end) - np.sin(0.3), np.cos(0.3) - np.cos(end)])
    assert position == pytest.approx(exact, abs=1e-3)


def test_impossible_values_are_refused():
    with pytest.raises(RobotError, match="max_speed"):
        DriveConfig(max_speed=0.0)
    with pytest.raises(RobotError, match="finite"):
        DifferentialDrive().command(float("nan"), 0.0)
