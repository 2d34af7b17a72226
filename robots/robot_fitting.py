"""Cover a whole robot with spheres under one budget, and find the link pairs that need no collision test."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import trimesh

from robots.convex_shape import Shape
from robots.errors import RobotError, UnknownLinkError
from robots.kinematic_tree import KinematicTree
from robots.link_geometry import collision_pieces
from robots.link_pairs import PairConfig, untested_pairs
from robots.model import Robot
from robots.numbers import refuse_nan
from robots.sphere_fitting import GrowingCover, SphereFit
from robots.spheres import SphereSet


@dataclass(frozen=True)
class RobotFitConfig:
    """How spheres are shared out among bodies; `pairs`: how unneeded self-collision pairs are found."""

    # Bodies of this size and above get the full overshoot, smaller ones (size / coarse_size) ** size_exponent
    # of it: a palm wants finer spheres than a base.
    coarse_size: float = 0.5  # [m] diagonal of the bounding box
    size_exponent: float = 0.6
    # The body that never moves collides with nothing but the robot itself; it gets this multiple.
    static_factor: float = 2.0
    gap: float = 0.001  # [m] that geometry may stand out of the spheres: it spares many at edges and corners
    seed: int = 0
    pairs: PairConfig = field(default_factory=PairConfig)

    def __post_init__(self) -> None:
        refuse_nan(self)


def fit_robot(
    urdf: str | Path,
    budget: int,
    *,
    skip: Collection[str] = (),
    lowest: Mapping[str, float] | None = None,
    floor_links: Collection[str] = (),
    ignored_pairs: Collection[tuple[str, str]] = (),
    config: RobotFitConfig | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> tuple[SphereSet, dict[str, SphereFit]]:
    """Cover every link with collision geometry by spheres, at most `budget` in all.

    Links joined by fixed joints are covered as one body; a sphere then belongs to the link its centre lies
    deepest in.

    Args:
        urdf: the robot; meshes are covered by way of their convex hulls.
        budget: greatest number of spheres of the robot.
        skip: links to leave out, e.g. wheels inside of the base's outline.
        lowest: per link, the height [m, link frame] below which no sphere of its body may reach.
        floor_links: links that drive on the floor.
        ignored_pairs: link pairs known to need no self-collision test, beside those found.
        config: how the budget is shared out.
        progress: told how many spheres of the budget are placed.

    Returns the sphere set, with the link pairs that need no test already marked, and the quality of the
    fit of each body, by the name of its first link. Raises `RobotError` where the budget is too small,
    `UnknownLinkError` for link names that have no collision geometry.
    """
    config = config or RobotFitConfig()
    tree = KinematicTree.from_urdf(urdf)
    pieces = collision_pieces(urdf)
    lowest = dict(lowest or {})
    unknown = (set(skip) | set(lowest) | set(floor_links)) - set(pieces)
    if unknown:
        raise UnknownLinkError(
            f"{sorted(unknown)} have no collision geometry; links that do: {tuple(pieces)}"
        )
    bodies = [
        _Body(tree, links, pieces, lowest, config) for links in tree.rigid_bodies(set(pieces) - set(skip))
    ]
    if not bodies:
        raise RobotError(f"{urdf}: no link has collision geometry to cover (after skipping {sorted(skip)})")
    _share_out(bodies, budget, progress)
    rows: dict[str, np.ndarray] = {}
    report = {}
    for body in bodies:
        report[body.links[0]] = fit = body.cover.fit()
        rows.update(body.spheres_by_link(fit.spheres))
    spheres = SphereSet(rows, floor_links=frozenset(floor_links) & set(rows))
    robot = Robot.from_urdf(urdf, spheres)
    known = frozenset(frozenset(pair) for pair in ignored_pairs)
    return replace(spheres, ignored_pairs=known | untested_pairs(robot, config.pairs)), report


class _Body:
    """Links that do not move against each other, with their geometry in the frame of the first."""

    def __init__(
        self,
        tree: KinematicTree,
        links: tuple[str, ...],
        pieces: Mapping[str, list[trimesh.Trimesh]],
        lowest: Mapping[str, float],
        config: RobotFitConfig,
    ) -> None:
        poses = tree.link_transforms({})
        first = np.linalg.inv(poses[links[0]])
        self.links = links
        self._places = {link: first @ poses[link] for link in links}
        moved = {link: [p.copy().apply_transform(self._places[link]) for p in pieces[link]] for link in links}
        self._shapes = {link: Shape(parts, config.seed) for link, parts in moved.items()}
        whole = Shape([piece for parts in moved.values() for piece in parts], config.seed)
        heights = [self._places[link][2, 3] + lowest[link] for link in links if link in lowest]
        self.cover = GrowingCover(whole, max(heights) if heights else None, config.gap)
        self._scale = min(1.0, whole.size / config.coarse_size) ** config.size_exponent
        if tree.root in links:
            self._scale *= config.static_factor

    @property
    def excess(self) -> float:
        """Overshoot [m] of the body so far, in proportion to what a body of its size may have."""
        return self.cover.overshoot / self._scale

    def spheres_by_link(self, spheres: np.ndarray) -> dict[str, np.ndarray]:
        """Spheres (n, 4) of the body, each in the frame of the link that its centre lies deepest in."""
        gaps = np.stack([self._shapes[link].signed_distance(spheres[:, :3]) for link in self.links])
        owner = gaps.argmin(0)
        shared = {}
        for i, link in enumerate(self.links):
            if (owner == i).any():
                mine = spheres[owner == i].copy()
                inverse = np.linalg.inv(self._places[link])
                mine[:, :3] = mine[:, :3] @ inverse[:3, :3].T + inverse[:3, 3]
                shared[link] = mine
        return shared


def _share_out(bodies: Sequence[_Body], budget: int, progress: Callable[[int, int], None]) -> None:
    """Give each further ball to the body that is covered worst for its size."""
    if budget < len(bodies):
        raise RobotError(
            f"{budget} spheres do not cover {len(bodies)} bodies that move against each other; give more"
        )
    for placed in range(len(bodies), budget):
        growing = [body for body in bodies if not body.cover.stalled]
        if not growing:
            return
        max(growing, key=lambda body: body.excess).cover.add()
        progress(placed + 1, budget)
