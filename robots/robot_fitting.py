"""Cover a whole robot with spheres under one budget, and find the link pairs that need no collision test."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from robots.convex_shape import Shape
from robots.errors import RobotError, UnknownLinkError
from robots.kinematic_tree import KinematicTree
from robots.link_geometry import collision_pieces
from robots.model import Robot
from robots.sphere_fitting import GrowingCover, SphereFit
from robots.spheres import SphereSet


@dataclass(frozen=True)
class RobotFitConfig:
    """How spheres are shared out among bodies, and how unneeded self-collision pairs are found."""

    # Bodies of this size and above get the full overshoot, smaller ones (size / coarse_size) ** size_exponent
    # of it: a palm wants finer spheres than a base.
    coarse_size: float = 0.5  # [m] diagonal of the bounding box
    size_exponent: float = 0.6
    # The body that never moves collides with nothing but the robot itself; it gets this multiple.
    static_factor: float = 2.0
    gap: float = 0.001  # [m] that geometry may stand out of the spheres: it spares many at edges and corners
    pair_samples: int = 10_000  # random configurations behind the never/always rule
    near_samples: int = 100  # of these, the closest ones of a pair on which the real geometry is compared
    never_margin: float = 0.01  # [m] a pair counts as never colliding only if it stays this far apart
    always_share: float = 0.95  # a pair in collision this often is an artefact of overlapping spheres
    seed: int = 0


def fit_robot(
    urdf: str | Path,
    budget: int,
    *,
    skip: Collection[str] = (),
    lowest: Mapping[str, float] | None = None,
    floor_links: Collection[str] = (),
    ignored_pairs: Collection[tuple[str, str]] = (),
    config: RobotFitConfig | None = None,
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
        _Body(tree, links, pieces, lowest, config) for links in _rigid_bodies(tree, set(pieces) - set(skip))
    ]
    _share_out(bodies, budget)
    rows: dict[str, np.ndarray] = {}
    report = {}
    for body in bodies:
        report[body.links[0]] = fit = body.cover.fit()
        rows.update(body.spheres_by_link(fit.spheres))
    spheres = SphereSet(rows, floor_links=frozenset(floor_links) & set(rows))
    robot = Robot.from_urdf(urdf, spheres)
    known = frozenset(frozenset(pair) for pair in ignored_pairs)
    return replace(spheres, ignored_pairs=known | untested_pairs(robot, config)), report


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


def _rigid_bodies(tree: KinematicTree, links: Collection[str]) -> list[tuple[str, ...]]:
    """The links grouped by what fixed joints hold together, in the tree's order."""
    body_of = {tree.root: tree.root}
    groups: dict[str, list[str]] = {tree.root: [tree.root]}
    for joint in tree.joints:
        body = joint.child if joint.movable else body_of[joint.parent]
        body_of[joint.child] = body
        groups.setdefault(body, []).append(joint.child)
    kept = (tuple(link for link in group if link in links) for group in groups.values())
    return [group for group in kept if group]


def untested_pairs(robot: Robot, config: RobotFitConfig | None = None) -> frozenset[frozenset[str]]:
    """Link pairs that need no self-collision test: neighbours, and pairs that never or (almost) always touch.

    Judged on random configurations within the joint limits (unlimited joints: half a turn either way), as
    set-up tools for motion planners do. Where only the spheres touch, the collision geometry itself decides.
    """
    config = config or RobotFitConfig()
    links = tuple(robot.sphere_set.spheres)
    lower, upper = robot.joint_limits.clamp(-torch.pi, torch.pi).unbind(-1)
    generator = torch.Generator().manual_seed(config.seed)
    q = lower + (upper - lower) * torch.rand(config.pair_samples, robot.num_dofs, generator=generator)
    gaps = torch.cat([_link_gaps(robot, part, links) for part in q.split(500)])
    always = (gaps <= 0).float().mean(0) >= config.always_share
    pieces = collision_pieces(robot.urdf_path)
    shapes = {link: Shape(pieces[link], config.seed) for link in links if link in pieces}
    untested = set(robot.tree.neighbours(links))
    for a, first in enumerate(links):
        for b in range(a + 1, len(links)):
            pair = frozenset((first, links[b]))
            nearest = gaps[:, a, b].topk(min(config.near_samples, len(q)), largest=False)
            if pair in untested:
                continue
            never = bool(nearest.values[0] > config.never_margin)
            if not never and not always[a, b] and pair <= set(shapes):
                never = (
                    _geometry_gap(robot, q[nearest.indices], first, links[b], shapes) > config.never_margin
                )
            if never or always[a, b]:
                untested.add(pair)
    return frozenset(untested)


def _geometry_gap(robot: Robot, q: Tensor, first: str, second: str, shapes: Mapping[str, Shape]) -> float:
    """Least distance [m] between surface samples of two links over some configurations (n, dof)."""
    poses = robot.link_poses(q.double(), [first, second]).numpy()
    gap = float("inf")
    for a, b, inner, outer in ((0, 1, first, second), (1, 0, second, first)):
        points = shapes[inner].surface_points(300)
        relative = np.linalg.inv(poses[:, b]) @ poses[:, a]
        moved = points @ relative[:, :3, :3].transpose(0, 2, 1) + relative[:, None, :3, 3]
        gap = min(gap, float(shapes[outer].signed_distance(moved.reshape(-1, 3)).min()))
    return gap


def _link_gaps(robot: Robot, q: Tensor, links: tuple[str, ...]) -> Tensor:
    """Least distance (n, l, l) [m] between the spheres of each two links at configurations (n, dof)."""
    centres, radii = robot.spheres(q)
    counts = [len(robot.sphere_set.spheres[link]) for link in links]
    gaps = torch.cdist(centres, centres) - radii[:, None] - radii
    rows = torch.stack([part.amin(1) for part in gaps.split(counts, dim=1)], dim=1)
    return torch.stack([part.amin(2) for part in rows.split(counts, dim=2)], dim=2)


def _share_out(bodies: Sequence[_Body], budget: int) -> None:
    """Give each further ball to the body that is covered worst for its size."""
    if budget < len(bodies):
        raise RobotError(
            f"{budget} spheres do not cover {len(bodies)} bodies that move against each other; give more"
        )
    for _ in range(budget - len(bodies)):
        growing = [body for body in bodies if not body.cover.stalled]
        if not growing:
            return
        max(growing, key=lambda body: body.excess).cover.add()
