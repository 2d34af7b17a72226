"""Noise of a structured-light depth camera: what turns a rendered depth image into a measured one.

The model has the three parts of Choi, Zhou and Koltun (Robust Reconstruction of Indoor Scenes, CVPR 2015,
section 5), which iSDF (section 5) applies to its synthetic sequences: jittered pixels, disparity that is
noisy and quantised, and a smooth distortion that belongs to the individual camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from robots.errors import RobotError
from robots.numbers import refuse_nan


@dataclass(frozen=True)
class DepthNoiseConfig:
    """Size of each part; the defaults are those of a 640 x 480 PrimeSense camera (Kinect v1, Xtion).

    Whatever is given in pixels is in pixels of an image `native_width` wide, so that it means the same angle
    at every resolution.
    """

    native_width: int = 640
    baseline_focal: float = 35.13
    """Baseline times focal length [m px]: disparity = baseline_focal / depth."""
    disparity_step: float = 0.125
    """Quantisation of the disparity [px]; 0 leaves it continuous."""
    disparity_sigma: float = 0.0278
    """Standard deviation of Gaussian noise on the disparity [px]: 0.8 mm at 1 m, times depth squared."""
    pixel_sigma: float = 0.25
    """Standard deviation of the jitter of each pixel's position [px]; frays the edges of objects."""
    distortion: float = 0.005
    """Standard deviation of the camera's relative low-frequency depth error; 0 removes it."""
    distortion_waves: int = 3
    """Most half-waves of the distortion across the image, each way."""
    distortion_seed: int = 0
    """Which camera: the distortion is drawn once from it and then fixed."""
    max_range: float = 5.0
    """Farther depths [m] are returned as 0."""

    def __post_init__(self) -> None:
        refuse_nan(self)
        if min(self.disparity_step, self.disparity_sigma, self.pixel_sigma, self.distortion) < 0:
            raise RobotError(f"noise magnitudes must not be negative, got {self}")
        if min(self.native_width, self.baseline_focal, self.max_range, self.distortion_waves) <= 0:
            raise RobotError(f"sizes of the camera and of its range must be positive, got {self}")


class DepthNoise:
    """Callable noise model: `noise(depth, rng)` returns a noisy copy of a depth image."""

    def __init__(self, config: DepthNoiseConfig | None = None):
        self.config = config or DepthNoiseConfig()

    def __call__(
        self, depth: Float32[np.ndarray, "height width"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "height width"]:
        """Measure a depth image (height, width) [m] of any resolution, 0 = invalid.

        A pixel that sees nothing stays 0, and so does what lies beyond the range once noise is added. The
        jitter moves the borders of invalid regions by at most a few native pixels.
        """
        moved = self._jitter(depth, rng)
        moved = np.where(depth > 0, moved, 0.0)
        valid = moved > 0
        distorted = np.where(valid, moved * (1.0 + self.distortion_map(depth.shape)), 1.0)
        disparity = self.config.baseline_focal / distorted
        disparity = disparity + rng.normal(0.0, self.config.disparity_sigma, depth.shape)
        if self.config.disparity_step > 0:
            step = self.config.disparity_step
            disparity = np.round(disparity / step) * step
        measured = self.config.baseline_focal / np.maximum(disparity, 1e-6)
        valid &= measured <= self.config.max_range
        return np.where(valid, measured, 0.0).astype(np.float32)

    def distortion_map(self, shape: tuple[int, ...]) -> np.ndarray:
        """Relative depth error (height, width) of this camera: smooth, the same in every image."""
        c = self.config
        rng = np.random.default_rng(c.distortion_seed)
        waves = c.distortion_waves + 1
        weights = rng.normal(size=(waves, waves))
        weights[0, 0] = 0.0
        # Each product of two cosines has variance 1/4, of a single one 1/2: scale the sum to unit variance.
        variance = np.outer(np.where(np.arange(waves) > 0, 0.5, 1), np.where(np.arange(waves) > 0, 0.5, 1))
        weights *= c.distortion / np.sqrt((weights**2 * variance).sum())
        rows, columns = (np.cos(np.pi * np.outer(np.arange(waves), (np.arange(n) + 0.5) / n)) for n in shape)
        return rows.T @ weights @ columns

    def _jitter(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Look up every pixel at a slightly displaced position, rounded to the nearest pixel."""
        height, width = depth.shape
        sigma = self.config.pixel_sigma * width / self.config.native_width
        positions = np.rint(np.indices(depth.shape) + rng.normal(0, sigma, (2, *depth.shape))).astype(int)
        return depth[np.clip(positions[0], 0, height - 1), np.clip(positions[1], 0, width - 1)]
