"""A union of convex pieces, sampled: the distances and the points that a sphere fitter asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from robots.errors import RobotError

SURFACE_POINTS = 10_000  # samples that lead to the triangles near a point
PLANES_AT_ONCE = 64  # most points are above one of the first, whatever the number of all
NEAR_SAMPLES = 6  # of these, the nearest ones whose triangles are measured exactly


class Shape:
    """A union of convex pieces: distances to it, and points on and in it.

    Args:
        pieces: closed convex meshes [m]; a mesh that is not convex is replaced by its hull.
        seed: of the surface and volume samples.

    Raises `RobotError` where there is no piece.
    """

    def __init__(self, pieces: trimesh.Trimesh | Sequence[trimesh.Trimesh], seed: int = 0) -> None:
        pieces = [pieces] if isinstance(pieces, trimesh.Trimesh) else list(pieces)
        if not pieces:
            raise RobotError("there is no geometry to cover with spheres")
        self.hulls = [piece.convex_hull for piece in pieces]
        self.planes = [_planes(hull) for hull in self.hulls]
        bounds = np.stack([hull.bounds for hull in self.hulls])
        self.bounds = np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)])
        self._rng = np.random.default_rng(seed)
        self._triangles = np.concatenate([hull.triangles for hull in self.hulls])
        points, self._triangle_of = self._surface_sample(SURFACE_POINTS)
        self._surface = cKDTree(points)

    @property
    def size(self) -> float:
        """Diagonal of the bounding box [m]."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Depth (n,) [m] of points (n, 3) in the piece that they lie deepest in, negative outside.

        Exact inside of a single piece; near a seam between pieces, and outside, its value is a lower bound of
        depth and minus a lower bound of distance.
        """
        return np.max([(offsets - points @ normals.T).min(1) for normals, offsets in self.planes], axis=0)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (n, 3) lie inside (n,)."""
        inside = np.zeros(len(points), dtype=bool)
        for normals, offsets in self.planes:
            inside[~inside] = _below(points[~inside], normals, offsets, 0.0)
        return inside

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Distance (n,) [m] of points (n, 3) to the surface, negative inside.

        Measured to the triangles about the nearest surface samples.
        """
        _, nearest = self._surface.query(points, k=NEAR_SAMPLES)
        triangles = self._triangles[self._triangle_of[nearest.ravel()]]
        repeated = np.repeat(points, NEAR_SAMPLES, axis=0)
        feet = trimesh.triangles.closest_point(triangles, repeated)
        distance = np.linalg.norm(feet - repeated, axis=1).reshape(-1, NEAR_SAMPLES).min(1)
        return np.where(self.contains(points), -distance, distance)

    def surface_points(self, count: int) -> np.ndarray:
        """Random points (about count, 3) of the outer surface, seams between pieces left out, edges included."""
        return self._surface_sample(count)[0]

    def interior_points(self, count: int) -> np.ndarray:
        """About `count` interior points (n, 3), uniform in the bounding box, and each piece's centroid."""
        points = np.stack([hull.centroid for hull in self.hulls])
        for _ in range(40):
            drawn = self._rng.uniform(self.bounds[0], self.bounds[1], (count, 3))
            points = np.concatenate([points, drawn[self.contains(drawn)]])[: max(count, len(self.hulls))]
            if len(points) >= count:
                break
        return points

    def inner_centres(self, count: int) -> np.ndarray:
        """Places for ball centres (n, 3): interior points, the same nearer to the medial axis, and corners' insides."""
        points = self.interior_points(count)
        inwards = [points]
        for _ in range(2):
            points = self._deeper(points)
            inwards.append(points)
        per_hull = max(20, count // (4 * len(self.hulls)))
        for hull in self.hulls:
            vertices = self._rng.permutation(hull.vertices)[:per_hull]
            inwards += [vertices + share * (hull.centroid - vertices) for share in (0.1, 0.2, 0.35, 0.5)]
        found = np.concatenate(inwards)
        return found[self.contains(found)]

    def _deeper(self, points: np.ndarray) -> np.ndarray:
        """Points moved half their depth away from the nearest surface sample, where that is deeper."""
        _, nearest = self._surface.query(points)
        moved = points + 0.5 * (points - self._surface.data[nearest])
        return np.where((self.depth(moved) > self.depth(points))[:, None], moved, points)

    def _surface_sample(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) of the outer surface and the triangle (n,) each lies on."""
        areas = np.array([hull.area for hull in self.hulls])
        shares = np.maximum(1, np.round(count * areas / areas.sum())).astype(int)
        points, triangles, first = [], [], 0
        for i, (hull, share) in enumerate(zip(self.hulls, shares, strict=True)):
            drawn, faces = trimesh.sample.sample_surface(
                hull, int(share), seed=int(self._rng.integers(2**31))
            )
            on_edges, edge_faces = self._edge_points(hull, int(share) // 3)
            corner_faces = np.zeros(len(hull.vertices), dtype=int)
            corner_faces[hull.faces] = np.arange(len(hull.faces))[:, None]
            sampled = np.concatenate([drawn, hull.vertices, on_edges])
            exposed = ~self._buried(sampled, i)
            points.append(sampled[exposed])
            triangles.append(first + np.concatenate([faces, corner_faces, edge_faces])[exposed])
            first += len(hull.faces)
        return np.concatenate(points), np.concatenate(triangles)

    def _buried(self, points: np.ndarray, piece: int) -> np.ndarray:
        """Which points (n,) of a piece's surface lie inside of another piece."""
        buried = np.zeros(len(points), dtype=bool)
        for j, (normals, offsets) in enumerate(self.planes):
            if j != piece:
                buried[~buried] = _below(points[~buried], normals, offsets, -1e-9)
        return buried

    def _edge_points(self, hull: trimesh.Trimesh, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Random points on the edges, with a face of each: there covers are thin, and area-weighted samples rare."""
        ends = hull.vertices[hull.face_adjacency_edges]
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        chosen = self._rng.choice(len(ends), count, p=lengths / lengths.sum())
        share = self._rng.random((count, 1))
        return ends[chosen, 0] + share * (ends[chosen, 1] - ends[chosen, 0]), hull.face_adjacency[chosen, 0]


def _below(points: np.ndarray, normals: np.ndarray, offsets: np.ndarray, most: float) -> np.ndarray:
    """Which points (n, 3) are at most `most` [m] above every plane; hulls of fine meshes have thousands of them."""
    left = np.arange(len(points))
    for first in range(0, len(normals), PLANES_AT_ONCE):
        block = slice(first, first + PLANES_AT_ONCE)
        left = left[(points[left] @ normals[block].T - offsets[block]).max(1) <= most]
        if len(left) == 0:
            break
    below = np.zeros(len(points), dtype=bool)
    below[left] = True
    return below


def _planes(hull: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals (f, 3) and offsets (f,) [m] of a hull's faces, coplanar triangles merged."""
    offsets = (hull.face_normals * hull.triangles[:, 0]).sum(1)
    rows = np.column_stack([hull.face_normals, offsets])
    _, kept = np.unique(np.round(rows, 6), axis=0, return_index=True)
    return rows[kept, :3], rows[kept, 3]
