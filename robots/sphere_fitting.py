"""Cover collision geometry with spheres under a budget, and measure how well spheres cover it.

`robots.ball_cover` finds the balls; what is reported about them is measured on points that it never saw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.distance import cdist

from robots.ball_cover import BallCover
from robots.convex_shape import Shape
from robots.errors import RobotError

GROWTH_POINTS = 50_000  # surface points that the final radii must contain,
GROWTH_ROUNDS = 8  # drawn anew so many times, or until all are contained
MEASURED_POINTS = 10_000  # fresh surface points that coverage is measured on
WORTHWHILE = 0.97  # another ball counts as a gain if it lowers the overshoot to this share
PATIENCE = 20  # balls in a row without a gain after which a shape gets no more


@dataclass(frozen=True)
class SphereFit:
    """Spheres (n, 4) of centre and radius [m] that cover a shape, and how well.

    `coverage` is the share of fresh surface points inside a sphere and `max_uncovered` [m] the distance
    of the worst one from the spheres; the overshoots [m] (mean, 95th percentile, greatest) tell how far the
    spheres' exposed surface lies outside of the shape.
    """

    spheres: np.ndarray
    coverage: float
    max_uncovered: float
    overshoot_mean: float
    overshoot_p95: float
    overshoot_max: float


def fit_spheres(
    shape: Shape | trimesh.Trimesh | Sequence[trimesh.Trimesh],
    budget: int,
    *,
    lowest: float | None = None,
    gap: float = 0.0,
    seed: int = 0,
) -> SphereFit:
    """Cover a shape with at most `budget` spheres that protrude as little as possible.

    Args:
        shape: convex pieces in the link frame [m].
        budget: greatest number of spheres; fewer are used where more would not help.
        lowest: height [m, link frame] that no sphere may go below, e.g. 2 cm under the floor.
        gap: distance [m] that the surface may stand out of the spheres, at corners mostly.
        seed: of the samples.

    Raises `RobotError` for a budget below 1 or where the shape itself reaches below `lowest`.
    """
    if budget < 1:
        raise RobotError(f"the sphere budget is {budget}, it must be at least 1")
    cover = GrowingCover(shape if isinstance(shape, Shape) else Shape(shape, seed), lowest, gap)
    while len(cover) < budget and not cover.stalled:
        cover.add()
    return cover.fit()


class GrowingCover:
    """A cover of one shape that grows ball by ball and remembers the last ball that was worth it."""

    def __init__(self, shape: Shape, lowest: float | None = None, gap: float = 0.0) -> None:
        self.shape = shape
        self._lowest = -math.inf if lowest is None else lowest
        self._cover = BallCover(shape, lowest, gap)
        self._gap = gap
        self._best, self._best_overshoot = self._cover.centres, self._cover.overshoot

    def __len__(self) -> int:
        return len(self._cover)

    @property
    def overshoot(self) -> float:
        """How far [m] the balls protrude at most."""
        return self._cover.overshoot

    @property
    def stalled(self) -> bool:
        """Whether the last balls have not helped: the shape is best covered by what there was before."""
        return len(self) - len(self._best) >= PATIENCE or self.overshoot <= 0

    def add(self) -> None:
        """Add a ball."""
        self._cover.add()
        if self.overshoot <= WORTHWHILE * self._best_overshoot:
            self._best, self._best_overshoot = self._cover.centres, self.overshoot

    def fit(self) -> SphereFit:
        """The spheres, balls that did not help left out, grown to what denser samples show, and measured."""
        self._cover.restart(self._best)
        spheres = self._cover.balls()
        for _ in range(GROWTH_ROUNDS):
            points = self.shape.surface_points(GROWTH_POINTS)
            if protruding(spheres, points).max() <= self._gap:
                break
            spheres = _grown_to(spheres, points, self._lowest, self._gap)
        return measure(spheres, self.shape)


def measure(spheres: np.ndarray, shape: Shape) -> SphereFit:
    """How well spheres (n, 4) [m] cover a shape, on fresh samples of the shape and of the spheres."""
    gaps = protruding(spheres, shape.surface_points(MEASURED_POINTS))
    overshoot = shape.signed_distance(exposed_points(spheres)).clip(min=0)
    return SphereFit(
        spheres,
        float((gaps <= 0).mean()),
        float(gaps.max().clip(min=0)),
        float(overshoot.mean()),
        float(np.quantile(overshoot, 0.95)),
        float(overshoot.max()),
    )


def exposed_points(spheres: np.ndarray, per_sphere: int = 400) -> np.ndarray:
    """Points (p, 3) spread over the surface of a union of spheres (n, 4) [m], weighted by sphere, not by area."""
    directions = _fibonacci_sphere(per_sphere)
    exposed = []
    for i, sphere in enumerate(spheres):
        points = sphere[:3] + sphere[3] * directions
        others = np.delete(spheres, i, axis=0)
        hidden = (cdist(points, others[:, :3]) < others[:, 3]).any(1)
        exposed.append(points[~hidden])
    return np.concatenate(exposed)


def _grown_to(spheres: np.ndarray, points: np.ndarray, lowest: float, gap: float) -> np.ndarray:
    """Grow the spheres until no point is further than `gap` from them [m].

    For each such point the sphere grows that needs to grow least, preferably not below `lowest`.
    """
    spheres = spheres.copy()
    for point in points[protruding(spheres, points) > gap]:
        distances = np.linalg.norm(spheres[:, :3] - point, axis=1) - gap
        growth = distances - spheres[:, 3]
        # Reaching below the height limit weighs thirtyfold: it may cost growth elsewhere, but not any amount.
        growth += 30.0 * (lowest - (spheres[:, 2] - distances)).clip(min=0)
        nearest = int(growth.argmin())
        spheres[nearest, 3] = max(spheres[nearest, 3], distances[nearest])
    return spheres


def protruding(spheres: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Signed distance (n,) [m] of points to the union of spheres, negative inside."""
    return (cdist(points, spheres[:, :3]) - spheres[:, 3]).min(1)


def _fibonacci_sphere(count: int) -> np.ndarray:
    """Evenly spread unit vectors (count, 3)."""
    index = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / count), math.pi * (1 + math.sqrt(5)) * index
    sine = np.sin(polar)
    return np.column_stack([np.cos(azimuth) * sine, np.sin(azimuth) * sine, np.cos(polar)])
