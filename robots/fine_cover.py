"""A second, finer cover of a robot's surface: many balls that protrude by a millimetre or two.

Coarse spheres are what an optimiser can afford; whether a gripper fits between two boards is decided by these.
Only the surface is covered, since nothing gets inside of a body without crossing it.
"""

from __future__ import annotations

import hashlib
import heapq
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree

from robots.link_geometry import collision_pieces
from robots.mesh_paths import cache_dir
from robots.numbers import refuse_nan

Balls = Float[np.ndarray, "n 4"]


@dataclass(frozen=True)
class FineCoverConfig:
    """How fine the cover is.

    Args:
        overshoot: how far a ball may protrude from a convex piece [m].
        uncovered: how deep below the surface an obstacle's corner may get between the balls [m].
        spacing: distance of the surface points that must be covered [m].
        largest: radius of the largest ball [m]; larger ones cover more but are slow to tell apart.
        large_area: surface [m^2] of a piece above which overshoot and spacing grow with its size, up to twice; bases
            and torsos need not pass between two boards.
    """

    overshoot: float = 0.0015
    uncovered: float = 0.0005
    spacing: float = 0.003
    largest: float = 0.04
    large_area: float = 0.12

    def __post_init__(self) -> None:
        refuse_nan(self)


def fine_cover(urdf: str | Path, config: FineCoverConfig | None = None) -> dict[str, Balls]:
    """Balls (n, 4) of centre and radius [m, link frame] for every link with collision geometry.

    Computed once for each geometry and kept in the user's cache. Raises `UrdfError` where meshes are missing.
    """
    config = config or FineCoverConfig()
    pieces = collision_pieces(urdf)
    path = cache_dir() / f"fine-{_digest(pieces, config)}.npz"
    if not path.is_file():
        covers = {
            link: np.concatenate([cover_hull(p, config) for p in parts]) for link, parts in pieces.items()
        }
        with path.with_suffix(".part").open("wb") as handle:
            np.savez(handle, **covers)  # type: ignore[arg-type]
        path.with_suffix(".part").replace(path)
    with np.load(path) as stored:
        return {link: stored[link] for link in stored.files}


def cover_hull(piece: trimesh.Trimesh, config: FineCoverConfig, seed: int = 0) -> Balls:
    """Balls that cover the surface of a convex piece: a greedy set cover by inscribed balls, grown a little.

    The largest ball inside the hull that touches it in p has its centre at p - R n, with R the least over the
    faces k of slack_k(p) / (1 - n_k . n); grown by h it protrudes by at most h.
    """
    hull = piece.convex_hull
    coarser = min(2.0, max(1.0, (hull.area / config.large_area) ** 0.5))
    config = replace(config, overshoot=coarser * config.overshoot, spacing=coarser * config.spacing)
    targets, normals = _surface(hull, config.spacing, seed)
    planes = np.unique(
        np.round(np.c_[hull.face_normals, (hull.face_normals * hull.triangles[:, 0]).sum(1)], 7), axis=0
    )
    centres, radii = _candidates(targets, normals, planes, config)
    tree = cKDTree(targets - config.uncovered * normals)
    covers = tree.query_ball_point(centres, radii)
    return _greedy(centres, radii, covers, len(targets))


def _surface(hull: trimesh.Trimesh, spacing: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the surface about `spacing` apart, the vertices among them, and normals there."""
    points, faces = trimesh.sample.sample_surface(hull, int(2.0 * hull.area / spacing**2) + 32, seed=seed)
    edges = hull.face_adjacency_edges[hull.face_adjacency_angles > 0.3]
    along = [hull.vertices]
    for a, b in hull.vertices[edges]:
        count = int(np.linalg.norm(b - a) / spacing) + 1
        along.append(a + np.linspace(0, 1, count + 1)[:, None] * (b - a))
    sharp = np.concatenate(along)
    sharp_normals = hull.vertex_normals[cKDTree(hull.vertices).query(sharp)[1]]
    return np.concatenate([sharp, points]), np.concatenate([sharp_normals, hull.face_normals[faces]])


def _candidates(
    points: np.ndarray, normals: np.ndarray, planes: np.ndarray, config: FineCoverConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Centres and grown radii of balls touching the surface in the points, of the largest size and of halves."""
    radius = np.full(len(points), config.largest)
    for block in np.array_split(np.arange(len(points)), len(points) // 500 + 1):
        slack = np.maximum(planes[:, 3] - points[block] @ planes[:, :3].T, 0.0)
        turn = np.maximum(1.0 - normals[block] @ planes[:, :3].T, 1e-9)
        radius[block] = np.minimum(radius[block], np.where(turn > 1e-6, slack / turn, np.inf).min(1))
    centres = [points - share * radius[:, None] * normals for share in (1.0, 0.5, 0.25)]
    radii = [share * radius + config.overshoot for share in (1.0, 0.5, 0.25)]
    return np.concatenate(centres), np.concatenate(radii)


def _greedy(centres: np.ndarray, radii: np.ndarray, covers: np.ndarray, targets: int) -> Balls:
    """The balls of a greedy cover: always the one that contains most of what is not covered yet."""
    left = np.ones(targets, dtype=bool)
    heap = [(-len(cover), i) for i, cover in enumerate(covers)]
    heapq.heapify(heap)
    chosen = []
    while heap:
        promised, i = heapq.heappop(heap)
        gain = int(left[covers[i]].sum())
        if gain == 0:
            continue
        if -promised > gain:
            heapq.heappush(heap, (-gain, i))
            continue
        chosen.append(i)
        left[covers[i]] = False
    return np.c_[centres[chosen], radii[chosen]]


def _digest(pieces: dict[str, list[trimesh.Trimesh]], config: FineCoverConfig) -> str:
    digest = hashlib.sha256(repr(config).encode())
    for link, parts in pieces.items():
        digest.update(link.encode())
        for part in parts:
            digest.update(np.ascontiguousarray(part.vertices).tobytes())
    return digest.hexdigest()[:16]
