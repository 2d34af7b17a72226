"""Whether configurations and straight edges are free, by walks through the sphere tree."""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from planning.compiled.arrays import Chain, Solids, SphereTree
from planning.compiled.kinematics import poses
from planning.compiled.solids import FLOOR_SLOPE, beyond, grid_sample, solid_distance, solid_is_floor


class World(NamedTuple):
    """All that decides whether a configuration is free.

    `weights` bound the motion of any sphere per unit of a joint [m]; spheres keep `margin` from solids and
    `self_margin` from each other [m]; links on the floor are excused from it within `floor_tolerance` [m].
    """

    chain: Chain
    tree: SphereTree
    solids: Solids
    low: np.ndarray
    high: np.ndarray
    weights: np.ndarray
    margin: float
    self_margin: float
    floor_tolerance: float


@njit(cache=True, nogil=True)
@no_type_check
def free(world: World, q: np.ndarray) -> bool:
    """Whether a configuration keeps its limits and margins; links that no joint moves are not looked at."""
    for j in range(len(q)):
        if not (world.low[j] <= q[j] <= world.high[j]):
            return False
    frames = poses(world.chain, q)
    tree, solids = world.tree, world.solids
    if not _clear_of_solids(
        tree.ball,
        tree.walk,
        tree.roots,
        tree.floor,
        solids.table,
        frames,
        world.margin,
        world.floor_tolerance,
    ):
        return False
    if len(solids.grid) > 0 and not _clear_of_grid(tree, solids, frames, world.margin, world.floor_tolerance):
        return False
    return _links_apart(tree.ball, tree.walk, tree.roots, tree.pairs, frames, world.self_margin)


@njit(cache=True, nogil=True)
@no_type_check
def _clear_of_solids(
    ball: np.ndarray,
    walk: np.ndarray,
    roots: np.ndarray,
    floor: np.ndarray,
    table: np.ndarray,
    frames: np.ndarray,
    margin: float,
    tolerance: float,
) -> bool:
    """Whether all spheres keep the margin from all solids; only solids near a whole link are looked at twice."""
    near = np.empty(len(table), np.int64)
    for link in range(len(roots) - 1):
        node, end = roots[link], roots[link + 1]
        if walk[node, 0] == 0:
            continue
        x, y, z = at(frames, ball, walk, node)
        reach = ball[node, 3] + margin
        count = 0
        for i in range(len(table)):
            if not beyond(table, i, x, y, z, reach) and not solid_distance(table, i, x, y, z) >= reach:
                near[count] = i
                count += 1
        if count == 0:
            continue
        while node < end:
            x, y, z = at(frames, ball, walk, node)
            reach = ball[node, 3] + margin
            clear = True
            for k in range(count):
                d = solid_distance(table, near[k], x, y, z)
                if not d >= reach:
                    excused = floor[link] and walk[node, 2] == 1
                    if not (excused and solid_is_floor(table, near[k], d, x, y, z, tolerance)):
                        clear = False
                        break
            if clear:
                node = walk[node, 1]
            elif walk[node, 2] == 1:
                return False
            else:
                node += 1
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _clear_of_grid(
    tree: SphereTree, solids: Solids, frames: np.ndarray, margin: float, tolerance: float
) -> bool:
    """Whether all spheres keep the margin from what the grid holds."""
    for link in range(len(tree.roots) - 1):
        node, end = tree.roots[link], tree.roots[link + 1]
        while node < end and tree.walk[node, 0] > 0:
            x, y, z = at(frames, tree.ball, tree.walk, node)
            d, _, _, up = grid_sample(solids, x, y, z)
            leaf = tree.walk[node, 2] == 1
            floor = leaf and tree.floor[link] and abs(d - z) <= tolerance and up > FLOOR_SLOPE
            if d >= tree.ball[node, 3] + margin or floor:
                node = tree.walk[node, 1]
            elif leaf:
                return False
            else:
                node += 1
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _links_apart(
    ball: np.ndarray,
    walk: np.ndarray,
    roots: np.ndarray,
    pairs: np.ndarray,
    frames: np.ndarray,
    margin: float,
) -> bool:
    """Whether no two links that may not touch do."""
    for p in range(len(pairs)):
        a, a_end = roots[pairs[p, 0]], roots[pairs[p, 0] + 1]
        root, end = roots[pairs[p, 1]], roots[pairs[p, 1] + 1]
        bx, by, bz = at(frames, ball, walk, root)
        while a < a_end:
            ax, ay, az = at(frames, ball, walk, a)
            if gap(ax, ay, az, bx, by, bz) >= ball[a, 3] + ball[root, 3] + margin:
                a = walk[a, 1]
                continue
            if walk[a, 2] == 1:
                b = root
                while b < end:
                    x, y, z = at(frames, ball, walk, b)
                    if gap(ax, ay, az, x, y, z) >= ball[a, 3] + ball[b, 3] + margin:
                        b = walk[b, 1]
                    elif walk[b, 2] == 1:
                        return False
                    else:
                        b += 1
            a += 1
    return True


@njit(cache=True, nogil=True)
@no_type_check
def at(frames: np.ndarray, ball: np.ndarray, walk: np.ndarray, node: int) -> tuple[float, float, float]:
    """World position of a node's centre [m]."""
    f = walk[node, 0]
    a, b, c = ball[node, 0], ball[node, 1], ball[node, 2]
    return (
        frames[f, 0, 0] * a + frames[f, 0, 1] * b + frames[f, 0, 2] * c + frames[f, 0, 3],
        frames[f, 1, 0] * a + frames[f, 1, 1] * b + frames[f, 1, 2] * c + frames[f, 1, 3],
        frames[f, 2, 0] * a + frames[f, 2, 1] * b + frames[f, 2, 2] * c + frames[f, 2, 3],
    )


@njit(cache=True, nogil=True)
@no_type_check
def gap(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Distance of two points [m]."""
    return math.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)


@njit(cache=True, nogil=True)
@no_type_check
def motion(world: World, a: np.ndarray, b: np.ndarray) -> float:
    """Bound [m] on the motion of any sphere from a to b."""
    total = 0.0
    for j in range(len(a)):
        total += abs(b[j] - a[j]) * world.weights[j]
    return total


@njit(cache=True, nogil=True)
@no_type_check
def edge_free(world: World, a: np.ndarray, b: np.ndarray, resolution: float) -> bool:
    """Whether the straight edge from a (known to be free) to b is; coarse states first, then ever finer ones."""
    count = max(1, math.ceil(motion(world, a, b) / resolution))
    q = b.copy()
    if not free(world, q):
        return False
    stride = 1
    while stride < count:
        stride *= 2
    while stride >= 2:
        half = stride // 2
        for i in range(half, count, stride):
            for j in range(len(a)):
                q[j] = a[j] + (b[j] - a[j]) * (i / count)
            if not free(world, q):
                return False
        stride = half
    return True


@njit(cache=True, nogil=True)
@no_type_check
def first_blocked(world: World, path: np.ndarray, resolution: float) -> int:
    """Index of the first waypoint that is not free or whose edge to the next is not; -1 if the path is free."""
    if not free(world, path[0]):
        return 0
    for i in range(len(path) - 1):
        if not edge_free(world, path[i], path[i + 1], resolution):
            return i
    return -1
