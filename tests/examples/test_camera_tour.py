"""The camera of a recording moves as smoothly as a neck turns it."""

from __future__ import annotations

import numpy as np
import pytest

from examples.camera_tour import Gaze

PERIOD = 1 / 30


def azimuths(gaze: Gaze, rays: np.ndarray, yaws: np.ndarray) -> np.ndarray:
    looks = [gaze.towards(ray, float(yaw), PERIOD) for ray, yaw in zip(rays, yaws, strict=True)]
    return np.unwrap([np.arctan2(look[1], look[0]) for look in looks])


def test_it_comes_to_face_what_is_looked_at_without_overshoot() -> None:
    ray = np.array([1.0, 1.0, -0.5])
    gaze = Gaze(0.0)
    turned = azimuths(gaze, np.tile(ray, (120, 1)), np.zeros(120))
    assert turned[-1] == pytest.approx(np.pi / 4, abs=1e-2) and turned.max() < np.pi / 4 + 0.02
    look = gaze.towards(ray, 0.0, PERIOD)
    assert look == pytest.approx(ray / np.linalg.norm(ray), abs=1e-2)


@pytest.mark.parametrize("start", [0.0, 2.5, -3.0])
def test_what_passes_behind_is_followed_over_the_front_at_a_bounded_speed(start) -> None:
    # The base turns once round at 1 rad/s, what it looks at stays where it is.
    yaws = start + np.arange(0.0, 2 * np.pi, PERIOD)
    ray = np.array([np.cos(start), np.sin(start), 0.0])
    turned = azimuths(Gaze(start), np.tile(ray, (len(yaws), 1)), yaws)
    assert np.abs(np.diff(turned)).max() <= 1.2 * PERIOD + 1e-9
    # Left behind on the right, then found again on the left: never past what the neck reaches, but for its lag.
    assert np.abs(turned - turned[0] - (yaws - yaws[0])).max() < 1.25 + 0.6
