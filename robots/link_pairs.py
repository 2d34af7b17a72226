"""Which link pairs need no self-collision test: neighbours, pairs that never touch, pairs that always do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from robots.convex_shape import Shape
from robots.link_geometry import collision_pieces
from robots.model import Robot
from robots.numbers import refuse_nan

Reason = Literal["adjacent", "always", "never"]


@dataclass(frozen=True)
class PairConfig:
    """How random configurations decide about a pair."""

    samples: int = 10_000  # random configurations behind the never/always rule
    near_samples: int = 100  # of these, the closest ones of a pair on which the real geometry is compared
    never_margin: float = 0.01  # [m] a pair counts as never colliding only if it stays this far apart
    always_share: float = 0.95  # a pair in collision this often is an artefact of overlapping spheres
    seed: int = 0

    def __post_init__(self) -> None:
        refuse_nan(self)


def untested_pairs(robot: Robot, config: PairConfig | None = None) -> frozenset[frozenset[str]]:
    """Link pairs that need no self-collision test, whatever the reason (see `pair_reasons`)."""
    return frozenset(pair_reasons(robot, config))


def pair_reasons(robot: Robot, config: PairConfig | None = None) -> dict[frozenset[str], Reason]:
    """Link pairs that need no self-collision test, and why: neighbours, or they never or (almost) always touch.

    Judged on random configurations within the joint limits (unlimited joints: half a turn either way), as
    set-up tools for motion planners do. Where only the spheres touch, the collision geometry itself decides.
    """
    config = config or PairConfig()
    links = tuple(robot.sphere_set.spheres)
    q = random_configurations(robot, config.samples, config.seed)
    gaps = torch.cat([_link_gaps(robot, part, links) for part in q.split(500)])
    always = (gaps <= 0).float().mean(0) >= config.always_share
    pieces = collision_pieces(robot.urdf_path)
    shapes = {link: Shape(pieces[link], config.seed) for link in links if link in pieces}
    reasons: dict[frozenset[str], Reason] = {pair: "adjacent" for pair in robot.tree.neighbours(links)}
    for a, first in enumerate(links):
        for b in range(a + 1, len(links)):
            pair = frozenset((first, links[b]))
            if pair in reasons:
                continue
            nearest = gaps[:, a, b].topk(min(config.near_samples, len(q)), largest=False)
            never = bool(nearest.values[0] > config.never_margin)
            if not never and not always[a, b] and pair <= set(shapes):
                gap = _geometry_gap(robot, q[nearest.indices], first, links[b], shapes)
                never = gap > config.never_margin
            if never or always[a, b]:
                reasons[pair] = "never" if never else "always"
    return reasons


def random_configurations(robot: Robot, count: int, seed: int = 0) -> Tensor:
    """Configurations (count, dof) [rad | m] drawn uniformly within the limits (unlimited: half a turn either way)."""
    lower, upper = robot.joint_limits.clamp(-torch.pi, torch.pi).unbind(-1)
    generator = torch.Generator().manual_seed(seed)
    return lower + (upper - lower) * torch.rand(count, robot.num_dofs, generator=generator)


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
