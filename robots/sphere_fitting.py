"""Cover collision geometry with spheres: greedy set cover of balls about the medial axis, then shrinking.

A ball about an interior point c at depth d(c) with radius d(c) + h protrudes at most h from the shape,
because the distance function grows no faster than the way travelled. Covering the shape with the fewest
such balls is a set cover; the budget decides h by bisection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from robots.errors import RobotError

# Distances are taken to a dense surface sample; this many points keep their error near a millimetre.
SURFACE_POINTS = 10_000
COVER_POINTS = 1_500  # surface points that the greedy cover must contain
CANDIDATES = 1_600  # random interior ball centres it chooses from
GROWTH_POINTS = 30_000  # surface points that the final radii must contain
HEIGHT_RESERVE = 0.01  # [m] kept above the height limit for the final growth of the radii
RESTARTS = 4  # perturbed repetitions of the greedy cover


@dataclass(frozen=True)
class SphereFit:
    """Spheres (n, 4) of centre and radius [m] that cover a shape, and how well.

    `coverage` is the share of fresh surface points inside a sphere and `max_uncovered` [m] the distance
    of the worst one from the spheres; `overshoot_mean` and `overshoot_max` [m] tell how far the spheres'
    exposed surface lies outside of the shape.
    """

    spheres: np.ndarray
    coverage: float
    max_uncovered: float
    overshoot_mean: float
    overshoot_max: float


class Shape:
    """A union of convex pieces, sampled: distance queries and cover points for the fitter.

    Args:
        pieces: closed convex meshes [m]; a mesh that is not convex is replaced by its hull.
        seed: of the surface and volume samples.
    """

    def __init__(self, pieces: trimesh.Trimesh | Sequence[trimesh.Trimesh], seed: int = 0) -> None:
        pieces = [pieces] if isinstance(pieces, trimesh.Trimesh) else list(pieces)
        if not pieces:
            raise RobotError("there is no geometry to cover with spheres")
        hulls = [piece.convex_hull for piece in pieces]
        self._rng = np.random.default_rng(seed)
        self._planes = [
            (hull.face_normals, (hull.face_normals * hull.triangles[:, 0]).sum(1)) for hull in hulls
        ]
        self._hulls = hulls
        self.bounds = np.stack([hull.bounds for hull in hulls])
        self.bounds = np.stack([self.bounds[:, 0].min(0), self.bounds[:, 1].max(0)])
        self._surface = cKDTree(self.surface_points(SURFACE_POINTS))

    @property
    def size(self) -> float:
        """Diagonal of the bounding box [m]."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Unsigned distance (n,) [m] of points (n, 3) to the surface."""
        return self._surface.query(points)[0]

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Distance (n,) [m] of points (n, 3) to the surface, negative inside."""
        distance = self.distance(points)
        return np.where(self._inside(points), -distance, distance)

    def surface_points(self, count: int) -> np.ndarray:
        """Random points (about count, 3) of the outer surface, seams between pieces left out, edges included."""
        areas = np.array([hull.area for hull in self._hulls])
        shares = np.maximum(1, np.round(count * areas / areas.sum())).astype(int)
        points = []
        for i, (hull, share) in enumerate(zip(self._hulls, shares, strict=True)):
            sampled, _ = trimesh.sample.sample_surface(hull, int(share), seed=int(self._rng.integers(2**31)))
            sampled = np.concatenate([sampled, hull.vertices, self._edge_points(hull, int(share) // 3)])
            buried = np.zeros(len(sampled), dtype=bool)
            for j, (normals, offsets) in enumerate(self._planes):
                if i != j:
                    buried |= (sampled @ normals.T - offsets).max(1) < -1e-9
            points.append(sampled[~buried])
        return np.concatenate(points)

    def _edge_points(self, hull: trimesh.Trimesh, count: int) -> np.ndarray:
        """Random points on the edges: where covers by spheres are thin, and area-weighted samples are rare."""
        ends = hull.vertices[hull.edges_unique]
        lengths = hull.edges_unique_length
        chosen = self._rng.choice(len(ends), count, p=lengths / lengths.sum())
        share = self._rng.random((count, 1))
        return ends[chosen, 0] + share * (ends[chosen, 1] - ends[chosen, 0])

    def interior_points(self, count: int) -> np.ndarray:
        """About 2 `count` interior points (n, 3): random ones, and the same moved towards the medial axis."""
        low, high = self.bounds
        points = np.stack([hull.centroid for hull in self._hulls])
        for _ in range(40):
            drawn = self._rng.uniform(low, high, (count, 3))
            points = np.concatenate([points, drawn[self._inside(drawn)]])[:count]
            if len(points) == count:
                break
        vertices = np.concatenate([self._rng.permutation(hull.vertices)[:60] for hull in self._hulls])
        middles = np.concatenate(
            [np.repeat(h.centroid[None], min(60, len(h.vertices)), 0) for h in self._hulls]
        )
        # Balls that reach into corners have their centres on the way from the corner to the middle.
        corners = [vertices + share * (middles - vertices) for share in (0.15, 0.3, 0.45, 0.6)]
        return np.concatenate([points, *corners, self._towards_medial_axis(points)])

    def _towards_medial_axis(self, points: np.ndarray) -> np.ndarray:
        """Climb the depth: half a depth away from the nearest surface point stays inside, keep what is deeper."""
        points = points.copy()
        depth, nearest = self._surface.query(points)
        step = np.full(len(points), 0.5)
        for _ in range(10):
            trial = points + step[:, None] * (points - self._surface.data[nearest])
            reached, beside = self._surface.query(trial)
            better = reached > depth
            points[better], depth[better], nearest[better] = trial[better], reached[better], beside[better]
            step[~better] *= 0.5
        # Points nearer to the surface than the sample resolves may have climbed out.
        return points[self._inside(points)]

    def _inside(self, points: np.ndarray) -> np.ndarray:
        inside = np.zeros(len(points), dtype=bool)
        for normals, offsets in self._planes:
            inside |= (points @ normals.T - offsets).max(1) <= 0
        return inside


def fit_spheres(
    shape: Shape | trimesh.Trimesh | Sequence[trimesh.Trimesh],
    budget: int,
    *,
    lowest: float | None = None,
    seed: int = 0,
) -> SphereFit:
    """Cover a shape with at most `budget` spheres that protrude as little as possible.

    Args:
        shape: convex pieces in the link frame [m].
        budget: greatest number of spheres.
        lowest: height [m, link frame] that no sphere may go below, e.g. 2 cm under the floor.
        seed: of the samples.

    Raises `RobotError` for a budget below 1 or where `lowest` leaves nothing to cover the shape with.
    """
    if budget < 1:
        raise RobotError(f"the sphere budget is {budget}, it must be at least 1")
    shape = shape if isinstance(shape, Shape) else Shape(shape, seed)
    cover = BallCover(shape, lowest)
    low, high = 0.0, shape.size
    while high - low > 5e-4:
        middle = (low + high) / 2
        chosen = cover.choose(middle)
        if chosen is not None and len(chosen) <= budget:
            high = middle
        else:
            low = middle
    return cover.fit(high)


class BallCover:
    """The set-cover problem of one shape, to be solved for different overshoots."""

    def __init__(self, shape: Shape, lowest: float | None = None) -> None:
        self.shape = shape
        self._floor = -math.inf if lowest is None else lowest
        self._lowest = self._floor + HEIGHT_RESERVE
        self._centres = shape.interior_points(CANDIDATES)
        self._depths = shape.distance(self._centres)
        self._points = np.concatenate([shape.surface_points(COVER_POINTS), self._centres[::5]])
        self._gaps = cdist(self._points, self._centres).astype(np.float32)

    def choose(self, overshoot: float) -> np.ndarray | None:
        """Indices of few candidate balls that protrude at most `overshoot` [m] and contain all points.

        None where no choice of candidates does. The greedy cover is repeated with perturbed gains, since its
        first pick, the largest ball, is often not part of the smallest cover.
        """
        contains = self._gaps <= self._radii(overshoot).astype(np.float32)
        if not contains.any(1).all():
            return None
        rng = np.random.default_rng(0)
        gains = [np.ones(len(self._centres)), *rng.uniform(0.7, 1.0, (RESTARTS, len(self._centres)))]
        return min((greedy_cover(contains, gain) for gain in gains), key=len)

    def fit(self, overshoot: float) -> SphereFit:
        """Solve for an overshoot [m], shrink the balls to what they alone must contain, and measure."""
        chosen = self.choose(overshoot)
        if chosen is None:
            raise RobotError(
                f"no spheres that protrude at most {overshoot:.3f} m cover the shape; allow more, or a lower `lowest`"
            )
        spheres = self._shrunk(chosen, overshoot)
        return self._measured(_grown_to(spheres, self.shape.surface_points(GROWTH_POINTS), self._floor))

    def _radii(self, overshoot: float) -> np.ndarray:
        return np.minimum(self._depths + overshoot, self._centres[:, 2] - self._lowest)

    def _shrunk(self, chosen: np.ndarray, overshoot: float) -> np.ndarray:
        """Give each point to the ball it lies deepest in, then replace each ball by the best one for its points.

        The best ball is the one among all candidates that protrudes least while it contains the points.
        """
        radii = self._radii(overshoot)[chosen]
        for _ in range(4):
            owner = (self._gaps[:, chosen] - radii).argmin(1)
            kept = np.unique(owner)
            chosen, radii = chosen[kept].copy(), radii[kept].copy()
            for i, ball in enumerate(kept):
                needed = self._gaps[owner == ball].max(0)
                # Among equals prefer the small ball: it hides less free space beside the shape.
                protrusion = needed - self._depths + 0.05 * needed
                protrusion[self._centres[:, 2] - needed < self._lowest] = np.inf
                best = int(protrusion.argmin())
                if np.isfinite(protrusion[best]):
                    chosen[i], radii[i] = best, needed[best]
        return np.column_stack([self._centres[chosen], radii])

    def _measured(self, spheres: np.ndarray) -> SphereFit:
        gaps = _protruding(spheres, self.shape.surface_points(4 * COVER_POINTS))
        directions = _fibonacci_sphere(400)
        exposed = []
        for i, sphere in enumerate(spheres):
            points = sphere[:3] + sphere[3] * directions
            others = np.delete(spheres, i, axis=0)
            hidden = (cdist(points, others[:, :3]) < others[:, 3]).any(1)
            exposed.append(points[~hidden])
        overshoot = self.shape.signed_distance(np.concatenate(exposed)).clip(min=0)
        return SphereFit(
            spheres,
            float((gaps <= 0).mean()),
            float(gaps.max().clip(min=0)),
            overshoot.mean(),
            overshoot.max(),
        )


def greedy_cover(contains: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Columns of a boolean matrix (points, sets) that together contain every point, redundant ones removed.

    Each step takes the set with the greatest `gain` (per set) times the number of points it newly contains.
    """
    counts = contains.sum(0, dtype=np.int32)
    uncovered = np.ones(len(contains), dtype=bool)
    chosen: list[int] = []
    while uncovered.any():
        best = int(np.argmax(counts * gain))
        newly = contains[:, best] & uncovered
        chosen.append(best)
        counts -= contains[newly].sum(0, dtype=np.int32)
        uncovered &= ~newly
    times = contains[:, chosen].sum(1)
    kept = []
    for ball in chosen:
        if (times[contains[:, ball]] > 1).all():
            times = times - contains[:, ball]
        else:
            kept.append(ball)
    return np.array(kept)


def _grown_to(spheres: np.ndarray, points: np.ndarray, lowest: float) -> np.ndarray:
    """Grow, for each point outside of all spheres, the one that needs to grow least, preferably not below `lowest`."""
    spheres = spheres.copy()
    for point in points[_protruding(spheres, points) > 0]:
        distances = np.linalg.norm(spheres[:, :3] - point, axis=1)
        growth = distances - spheres[:, 3]
        # Reaching below the height limit weighs thrice: it may cost growth elsewhere, but not any amount.
        growth += 3.0 * (lowest - (spheres[:, 2] - distances)).clip(min=0)
        nearest = int(growth.argmin())
        spheres[nearest, 3] = max(spheres[nearest, 3], distances[nearest])
    return spheres


def _protruding(spheres: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Signed distance (n,) [m] of points to the union of spheres, negative inside."""
    return (cdist(points, spheres[:, :3]) - spheres[:, 3]).min(1)


def _fibonacci_sphere(count: int) -> np.ndarray:
    """Evenly spread unit vectors (count, 3)."""
    index = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / count), math.pi * (1 + math.sqrt(5)) * index
    sine = np.sin(polar)
    return np.column_stack([np.cos(azimuth) * sine, np.sin(azimuth) * sine, np.cos(polar)])
