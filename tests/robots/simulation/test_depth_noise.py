from __future__ import annotations

import numpy as np
import pytest

from robots.errors import RobotError
from robots.simulation import DepthNoise, DepthNoiseConfig

CLEAN = {"disparity_step": 0.0, "disparity_sigma": 0.0, "pixel_sigma": 0.0, "distortion": 0.0}


def _wall(depth: float, shape: tuple[int, int] = (120, 160)) -> np.ndarray:
    return np.full(shape, depth, dtype=np.float32)


def _noise(**changes) -> DepthNoise:
    return DepthNoise(DepthNoiseConfig(**{**CLEAN, **changes}))


def test_without_magnitudes_nothing_changes():
    depth = np.random.default_rng(0).uniform(0.4, 4.5, (30, 40)).astype(np.float32)
    np.testing.assert_allclose(_noise()(depth, np.random.default_rng(1)), depth, rtol=1e-6)


def test_disparity_noise_is_unbiased_and_grows_with_depth_squared():
    noise, rng = _noise(disparity_sigma=0.0278), np.random.default_rng(0)
    errors = {z: noise(_wall(z), rng) - z for z in (1.0, 2.0, 4.0)}
    for z, error in errors.items():
        expected = 0.0278 / 35.13 * z**2
        assert error.std() == pytest.approx(expected, rel=0.05)
        assert abs(error.mean()) < 4 * expected / np.sqrt(error.size) + 2 * expected**2 / z


def test_quantisation_steps_grow_with_depth_squared():
    ramp = np.linspace(1.0, 4.0, 200 * 300, dtype=np.float32).reshape(200, 300)
    image = _noise(disparity_step=0.125)(ramp, np.random.default_rng(0))
    assert abs((image - ramp).mean()) < 1e-3, "rounded to the nearest step, not downwards"
    measured = np.unique(image)
    steps, middle = np.diff(measured), (measured[1:] + measured[:-1]) / 2
    np.testing.assert_allclose(steps, 0.125 / 35.13 * middle**2, rtol=0.02)


def test_distortion_is_smooth_relative_and_belongs_to_the_camera():
    noise, other = _noise(distortion=0.01), _noise(distortion=0.01, distortion_seed=1)
    relative = noise(_wall(2.0), np.random.default_rng(0)) / 2.0 - 1
    assert relative.std() == pytest.approx(0.01, rel=0.3) and abs(relative.mean()) < 1e-3
    assert np.abs(np.diff(relative, axis=1)).max() < 0.002
    np.testing.assert_allclose(noise(_wall(4.0), np.random.default_rng(9)) / 4.0 - 1, relative, atol=1e-6)
    assert np.abs(other.distortion_map((120, 160)) - relative).max() > 0.005
    fine = noise.distortion_map((480, 640)).reshape(120, 4, 160, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(fine, noise.distortion_map((120, 160)), atol=1e-4)


def test_jitter_only_swaps_depths_near_edges():
    depth = _wall(1.0, (480, 640))
    depth[:, 320:] = 3.0
    measured = _noise(pixel_sigma=0.5)(depth, np.random.default_rng(0))
    changed = np.abs(measured - depth) > 1e-4
    assert set(np.unique(measured.round(4))) == {1.0, 3.0}
    assert changed.any() and not changed[:, :316].any() and not changed[:, 324:].any()


def test_invalid_stays_invalid_and_range_is_kept():
    depth = np.random.default_rng(0).uniform(0.3, 8.0, (480, 640)).astype(np.float32)
    depth[40:60, 50:90] = 0.0
    measured = DepthNoise()(depth, np.random.default_rng(1))
    assert (measured[40:60, 50:90] == 0).all(), "at the full resolution the jitter moves pixels"
    assert measured.max() <= 5.0 and (measured >= 0).all() and np.isfinite(measured).all()
    assert (measured[depth > 6.0] == 0).mean() > 0.8
    assert measured.dtype == np.float32
    assert (DepthNoise()(np.zeros((4, 5), np.float32), np.random.default_rng(0)) == 0).all()


def test_the_same_generator_state_gives_the_same_image():
    depth = _wall(2.0)
    first, again = (DepthNoise()(depth, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, DepthNoise()(depth, np.random.default_rng(4)))
    assert (depth == 2.0).all(), "the input must not be changed"


def test_impossible_values_are_refused():
    with pytest.raises(RobotError, match="negative"):
        DepthNoiseConfig(disparity_sigma=-1.0)
    with pytest.raises(RobotError, match="positive"):
        DepthNoiseConfig(max_range=0.0)
