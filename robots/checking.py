"""Check a robot's spheres against its collision geometry at random configurations, with pybullet as the judge."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import trimesh
from torch import Tensor

from robots.convex_shape import Shape
from robots.errors import RobotError
from robots.link_geometry import collision_pieces
from robots.link_pairs import random_configurations
from robots.model import Robot
from robots.self_collision import self_gaps
from robots.sphere_fitting import SphereFit, measure, protruding

MAX_UNCOVERED = 2e-3  # [m] that geometry may stand out of the spheres before a set counts as unsafe
# A mesh's hull is 1 mm larger in pybullet than it is; two of them seem 2 mm closer than they are.
ENGINE_MARGIN = 2e-3
POINTS_PER_BODY = 2_000


@dataclass(frozen=True)
class SphereCheck:
    """What random configurations say about a sphere set.

    `false_alarms` and `misses` count configurations where only the spheres, or only the hulls, of the link pairs
    that are tested collide; `worst_miss` [m] is the deepest contact that the spheres missed. `coverage` and
    `max_uncovered` [m] are those of geometry placed by the URDF's kinematics among spheres placed by the robot's;
    `bodies` has the fit of each group of links that do not move against each other; `uncovered_links` have
    collision geometry but no spheres.
    """

    configurations: int
    sphere_collisions: int
    hull_collisions: int
    false_alarms: int
    misses: int
    worst_miss: float
    coverage: float
    max_uncovered: float
    bodies: Mapping[str, SphereFit]
    uncovered_links: tuple[str, ...]

    @property
    def safe(self) -> bool:
        """Whether no geometry stands out of the spheres, and no contact is missed, by more than `MAX_UNCOVERED`."""
        return self.max_uncovered <= MAX_UNCOVERED and self.worst_miss <= MAX_UNCOVERED


def check_spheres(
    robot: Robot,
    configurations: int = 200,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> SphereCheck:
    """Compare a robot's spheres with the convex hulls of its collision geometry.

    Args:
        robot: the robot with the spheres to check.
        configurations: number of random configurations within the limits.
        seed: of the configurations and samples.
        progress: told how many configurations of all are done.

    Raises `RobotError` where pybullet is missing.
    """
    q = random_configurations(robot, configurations, seed)
    sphere_gaps = self_gaps(robot, q).double().numpy()
    hull_gaps = _hull_gaps(robot, q, progress)
    touching, colliding = sphere_gaps <= 0, hull_gaps <= 0
    missed = colliding & ~touching
    pieces = collision_pieces(robot.urdf_path)
    covered = [link for link in pieces if link in robot.sphere_set.spheres]
    gaps = np.concatenate([_surface_gaps(robot, values, pieces, covered, seed) for values in q[:20]])
    return SphereCheck(
        configurations=len(q),
        sphere_collisions=int(touching.sum()),
        hull_collisions=int(colliding.sum()),
        false_alarms=int((touching & ~colliding).sum()),
        misses=int(missed.sum()),
        worst_miss=float(-hull_gaps[missed].min()) if missed.any() else 0.0,
        coverage=float((gaps <= 0).mean()),
        max_uncovered=float(gaps.max().clip(min=0)),
        bodies=body_fits(robot, seed),
        uncovered_links=tuple(link for link in pieces if link not in robot.sphere_set.spheres),
    )


def body_fits(robot: Robot, seed: int = 0) -> dict[str, SphereFit]:
    """How well the spheres fit each group of links that do not move against each other, by the first link's name.

    Links that lack geometry or spheres are left out.
    """
    pieces = collision_pieces(robot.urdf_path)
    poses = robot.tree.link_transforms({})
    fits = {}
    for body in robot.tree.rigid_bodies(set(robot.sphere_set.spheres) & set(pieces)):
        moved = [p.copy().apply_transform(poses[link]) for link in body for p in pieces[link]]
        rows = []
        for link in body:
            spheres = robot.sphere_set.spheres[link].copy()
            spheres[:, :3] = spheres[:, :3] @ poses[link][:3, :3].T + poses[link][:3, 3]
            rows.append(spheres)
        fits[body[0]] = measure(np.concatenate(rows), Shape(moved, seed))
    return fits


def _surface_gaps(
    robot: Robot,
    q: Tensor,
    pieces: Mapping[str, list[trimesh.Trimesh]],
    links: Collection[str],
    seed: int,
) -> np.ndarray:
    """Signed distance (n,) [m] of the links' surface points to the robot's spheres at q, negative inside."""
    poses = robot.tree.link_transforms(robot.joint_values(q.double()))
    centres, radii = robot.spheres(q.double())
    spheres = np.column_stack([centres.numpy(), radii.numpy()])
    gaps = []
    for link in links:
        for piece in pieces[link]:
            points, _ = trimesh.sample.sample_surface(piece, POINTS_PER_BODY // 10, seed=seed)
            placed = np.concatenate([points, piece.vertices]) @ poses[link][:3, :3].T + poses[link][:3, 3]
            gaps.append(protruding(spheres, placed))
    return np.concatenate(gaps) if gaps else np.zeros(1)


def _hull_gaps(
    robot: Robot, q: Tensor, progress: Callable[[int, int], None], reach: float = 0.05
) -> np.ndarray:
    """Least distance (n,) [m] between tested links' hulls as pybullet sees it; inf past `reach`."""
    if find_spec("pybullet") is None:
        raise RobotError(
            "checking spheres needs pybullet, which is not installed; fix: pip install 'isdf-planning[simulation]'"
        )
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(
            str(robot.urdf_path),
            useFixedBase=True,
            flags=pybullet.URDF_IGNORE_VISUAL_SHAPES,
            physicsClientId=client,
        )
        infos = [
            pybullet.getJointInfo(body, i, physicsClientId=client)
            for i in range(pybullet.getNumJoints(body, physicsClientId=client))
        ]
        joints = {info[1].decode(): info[0] for info in infos}
        links = {info[12].decode(): info[0] for info in infos} | {robot.tree.root: -1}
        pairs = [tuple(links[link] for link in pair) for pair in tested_link_pairs(robot)]
        gaps = np.full(len(q), np.inf)
        for i, values in enumerate(q):
            for name, value in robot.joint_values(values).items():
                pybullet.resetJointState(body, joints[name], value, physicsClientId=client)
            for a, b in pairs:
                found = pybullet.getClosestPoints(body, body, reach, a, b, physicsClientId=client)
                gaps[i] = min([gaps[i], *(contact[8] + ENGINE_MARGIN for contact in found)])
            progress(i + 1, len(q))
        return gaps
    finally:
        pybullet.disconnect(client)


def tested_link_pairs(robot: Robot) -> list[tuple[str, str]]:
    """Pairs of links, sorted, whose spheres are tested against each other."""
    names = robot.sphere_links
    pairs = {tuple(sorted((names[i], names[j]))) for i, j in robot.self_collision_pairs.tolist()}
    return sorted((first, second) for first, second in pairs)
