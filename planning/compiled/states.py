"""Whether configurations and straight edges are free, by walks through the sphere tree."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from planning.compiled.arrays import Chain, Solids, SphereTree
from planning.compiled.kinematics import poses
from planning.compiled.solids import grid_sample, is_floor, solid_distance


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


@njit(cache=True)
def free(world: World, q: np.ndarray) -> bool:
    """Whether a configuration keeps its limits and margins."""
    for j in range(len(q)):
        if not (world.low[j] <= q[j] <= world.high[j]):
            return False
    frames = poses(world.chain, q)
    for link in range(len(world.tree.roots) - 1):
        if not _link_clear(world, frames, link, world.margin):
            return False
    return _links_apart(world, frames)


@njit(cache=True)
def _link_clear(world: World, frames: np.ndarray, link: int, margin: float) -> bool:
    """Whether all spheres of a link keep the margin; only solids near the whole link are looked at twice."""
    tree, solids = world.tree, world.solids
    root, end = tree.roots[link], tree.roots[link + 1]
    near = np.empty(len(solids.kind), np.int64)
    count = 0
    x, y, z = _at(frames, tree, root)
    reach = tree.radius[root] + margin
    for i in range(len(solids.kind)):
        if not solid_distance(solids, i, x, y, z) >= reach:
            near[count] = i
            count += 1
    grid = not grid_sample(solids, x, y, z)[0] >= reach
    if count == 0 and not grid:
        return True
    node = root
    while node < end:
        x, y, z = _at(frames, tree, node)
        reach = tree.radius[node] + margin
        excused = tree.floor[link] and tree.leaf[node]
        clear = True
        for k in range(count):
            d = solid_distance(solids, near[k], x, y, z)
            if not d >= reach and not (excused and is_floor(solids, near[k], d, x, y, z, world.floor_tolerance)):
                clear = False
                break
        if clear and grid:
            d = grid_sample(solids, x, y, z)[0]
            clear = d >= reach or (excused and is_floor(solids, -1, d, x, y, z, world.floor_tolerance))
        if clear:
            node = tree.skip[node]
        elif tree.leaf[node]:
            return False
        else:
            node += 1
    return True


@njit(cache=True)
def _links_apart(world: World, frames: np.ndarray) -> bool:
    """Whether no two links that may not touch do."""
    tree = world.tree
    for p in range(len(tree.pairs)):
        a, b = tree.pairs[p]
        if not _apart(tree, frames, tree.roots[a], tree.roots[a + 1], tree.roots[b], tree.roots[b + 1], world.self_margin):
            return False
    return True


@njit(cache=True)
def _apart(tree: SphereTree, frames: np.ndarray, a: int, a_end: int, b: int, b_end: int, margin: float) -> bool:
    bx, by, bz = _at(frames, tree, b)
    while a < a_end:
        ax, ay, az = _at(frames, tree, a)
        if _gap(ax, ay, az, bx, by, bz) - tree.radius[a] - tree.radius[b] >= margin:
            a = tree.skip[a]
            continue
        if tree.leaf[a]:
            node = b
            while node < b_end:
                x, y, z = _at(frames, tree, node)
                if _gap(ax, ay, az, x, y, z) - tree.radius[a] - tree.radius[node] >= margin:
                    node = tree.skip[node]
                elif tree.leaf[node]:
                    return False
                else:
                    node += 1
        a += 1
    return True


@njit(cache=True)
def _at(frames: np.ndarray, tree: SphereTree, node: int) -> tuple[float, float, float]:
    pose, c = frames[tree.frame[node]], tree.centre[node]
    return (
        pose[0, 0] * c[0] + pose[0, 1] * c[1] + pose[0, 2] * c[2] + pose[0, 3],
        pose[1, 0] * c[0] + pose[1, 1] * c[1] + pose[1, 2] * c[2] + pose[1, 3],
        pose[2, 0] * c[0] + pose[2, 1] * c[1] + pose[2, 2] * c[2] + pose[2, 3],
    )


@njit(cache=True)
def _gap(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    return math.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)


@njit(cache=True)
def motion(world: World, a: np.ndarray, b: np.ndarray) -> float:
    """Bound [m] on the motion of any sphere from a to b."""
    total = 0.0
    for j in range(len(a)):
        total += abs(b[j] - a[j]) * world.weights[j]
    return total


@njit(cache=True)
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


@njit(cache=True)
def first_blocked(world: World, path: np.ndarray, resolution: float) -> int:
    """Index of the first waypoint that is not free or whose edge to the next is not; -1 if the path is free."""
    if not free(world, path[0]):
        return 0
    for i in range(len(path) - 1):
        if not edge_free(world, path[i], path[i + 1], resolution):
            return i
    return -1

