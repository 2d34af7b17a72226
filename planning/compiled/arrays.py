"""The arrays that the compiled kernels work on: a robot's joints, a tree of its spheres, a scene's solids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from planning.protocols import CompilableField, CompilableRobot, FloorRobot

LEAVES = 4  # spheres below which a node of the sphere tree is not divided further


class Chain(NamedTuple):
    """Moving joints, as in `CompilableRobot.chain`."""

    parent: np.ndarray
    origin: np.ndarray
    axis: np.ndarray
    prismatic: np.ndarray
    column: np.ndarray
    multiplier: np.ndarray
    offset: np.ndarray


class SphereTree(NamedTuple):
    """Spheres within spheres, in the order of a walk from the roots, one root a link.

    A node is followed by its children; `skip` is the node that comes after all of them. Where a node is clear, all
    spheres in it are. Few arrays, since each costs some nanoseconds in every call that passes it.
    """

    ball: np.ndarray  # (n, 4) centre in its frame, radius
    walk: np.ndarray  # (n, 3) frame, skip, and 1 for a leaf
    roots: np.ndarray  # first node of each link, and the number of nodes
    pairs: np.ndarray  # of links that must not touch
    floor: np.ndarray  # whether a link may touch the floor


class Solids(NamedTuple):
    """Solids, one a row of `table`, and a voxel grid, empty where there is none.

    A row holds the rotation from world to solid (0-8), the centre (9-11), sizes (12-14), the radius of a ball round
    the solid (15) and its kind (16): 0 for a box with half sizes, 1 for a cylinder with radius and half height, 2 for
    a ball.
    One table instead of an array for each, since passing arrays to small functions costs more than these compute.
    """

    table: np.ndarray
    grid: np.ndarray
    low: np.ndarray
    voxel: float


def chain_of(robot: CompilableRobot) -> Chain:
    """A robot's joints as contiguous arrays of the types that the kernels are compiled for."""
    chain = robot.chain
    return Chain(
        np.ascontiguousarray(chain.parent, np.int64),
        np.ascontiguousarray(chain.origin, np.float64),
        np.ascontiguousarray(chain.axis, np.float64),
        np.ascontiguousarray(chain.prismatic, np.bool_),
        np.ascontiguousarray(chain.column, np.int64),
        np.ascontiguousarray(chain.multiplier, np.float64),
        np.ascontiguousarray(chain.offset, np.float64),
    )


def tree_of(robot: CompilableRobot) -> SphereTree:
    """The tree of a robot's fine spheres."""
    frame, balls, link = robot.fine_spheres()
    nodes: list[tuple[int, np.ndarray, float, int, bool]] = []
    roots = []
    for number in range(int(link.max()) + 1):
        roots.append(len(nodes))
        mine = link == number
        _grow(nodes, int(frame[mine][0]), np.asarray(balls[mine], np.float64))
    links = list(dict.fromkeys(robot.sphere_links))
    floor = np.zeros(len(links), np.bool_)
    if isinstance(robot, FloorRobot):
        standing = zip(robot.sphere_links, robot.floor_spheres.tolist(), strict=True)
        floor[[links.index(name) for name, on_floor in standing if on_floor]] = True
    frames, centres, radii, skips, leaves = zip(*nodes, strict=True)
    return SphereTree(
        np.c_[np.array(centres, np.float64), np.array(radii, np.float64)],
        np.ascontiguousarray(np.c_[frames, skips, leaves], np.int64),
        np.array([*roots, len(nodes)], np.int64),
        np.ascontiguousarray(robot.link_pairs, np.int64),
        floor,
    )


def solids_of(field: CompilableField) -> Solids:
    """A field's solids as contiguous arrays."""
    solids = field.solids
    n = len(solids.kind)
    table = np.zeros((n, 17))
    table[:, 0:9] = np.reshape(solids.turn, (n, 9))
    table[:, 9:12], table[:, 12:15] = solids.centre, solids.size
    table[:, 15] = np.linalg.norm(table[:, 12:15], axis=1)  # unused sizes are zero
    table[:, 16] = solids.kind
    return Solids(
        table,
        np.ascontiguousarray(solids.grid, np.float32),
        np.ascontiguousarray(solids.low, np.float64),
        float(solids.voxel),
    )


def _grow(
    nodes: list[tuple[int, np.ndarray, float, int, bool]], frame: int, balls: Float[np.ndarray, "n 4"]
) -> None:
    """Append the subtree of some balls, halved along their longest extent until few are left."""
    at = len(nodes)
    centre, radius = _enclosing(balls)
    nodes.append((frame, centre, radius, 0, False))
    if len(balls) <= LEAVES:
        if len(balls) == 1:
            nodes[at] = (frame, balls[0, :3], float(balls[0, 3]), at + 1, True)
            return
        for ball in balls:
            nodes.append((frame, ball[:3], float(ball[3]), len(nodes) + 1, True))
    else:
        order = np.argsort(balls[:, int(np.ptp(balls[:, :3], axis=0).argmax())])
        for half in np.array_split(order, 2):
            _grow(nodes, frame, balls[half])
    nodes[at] = (frame, centre, radius, len(nodes), False)


def _enclosing(balls: Float[np.ndarray, "n 4"]) -> tuple[Float[np.ndarray, "3"], float]:
    """A ball round others, nearly the smallest (Badoiu and Clarkson's iteration towards the farthest)."""
    centre = balls[:, :3].mean(0)
    for step in range(1, 60):
        reach = np.linalg.norm(balls[:, :3] - centre, axis=1) + balls[:, 3]
        farthest = balls[int(reach.argmax()), :3]
        centre = centre + (farthest - centre) / (step + 2)
    return centre, float((np.linalg.norm(balls[:, :3] - centre, axis=1) + balls[:, 3]).max()) + 1e-9


def joint_weights(
    chain: Chain, tree: SphereTree, low: Float[np.ndarray, " dof"], high: Float[np.ndarray, " dof"]
) -> Float[np.ndarray, " dof"]:
    """Most [m] that any sphere was seen to move per unit of each joint, over 200 random configurations."""
    from planning.compiled.kinematics import place, poses

    rng = np.random.default_rng(0)
    leaves = np.flatnonzero(tree.walk[:, 2])[::10]
    frame, centre = np.ascontiguousarray(tree.walk[leaves, 0]), np.ascontiguousarray(tree.ball[leaves, :3])
    weights = np.full(len(low), 1e-3)
    for q in rng.uniform(low, high, (200, len(low))):
        before = place(poses(chain, q), frame, centre)
        for joint in range(len(q)):
            moved = q.copy()
            moved[joint] += 1e-3
            turned = place(poses(chain, moved), frame, centre)
            weights[joint] = max(weights[joint], float(np.linalg.norm(turned - before, axis=1).max()) / 1e-3)
    return weights
