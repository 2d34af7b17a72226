"""How clear each of many states is: least clearance from solids and least gap between links."""

from __future__ import annotations

import numpy as np
from numba import njit

from planning.compiled.arrays import SphereTree
from planning.compiled.kinematics import poses
from planning.compiled.solids import FAR, grid_sample, is_floor, solid_distance
from planning.compiled.states import World, _at, _gap


@njit(cache=True)
def measure(world: World, states: np.ndarray, order: np.ndarray, floor: float, self_floor: float, widest: float):
    """Clearance, its link, self-collision gap and its pair for every state (n, dof), visited in an order.

    Values are exact where they are the least so far or below their floor [m], and upper bounds elsewhere; gaps are
    cut off at `widest`. NaN where the solids' distance is.
    """
    n = len(states)
    depth, link = np.empty(n), np.zeros(n, np.int64)
    gap, pair = np.empty(n), np.zeros((n, 2), np.int64)
    least, narrowest = np.inf, widest
    for s in order:
        frames = poses(world.chain, states[s])
        depth[s], link[s] = _clearance(world, frames, max(least, floor))
        least = min(least, depth[s])
        gap[s], pair[s, 0], pair[s, 1] = _least_gap(world.tree, frames, min(max(narrowest, self_floor), widest))
        narrowest = min(narrowest, gap[s])
    return depth, link, gap, pair


@njit(cache=True)
def _clearance(world: World, frames: np.ndarray, least: float) -> tuple[float, int]:
    """Least clearance of any leaf below a bound, else the bound, and the link that has it."""
    tree, solids, tolerance = world.tree, world.solids, world.floor_tolerance
    where = 0
    for link in range(len(tree.roots) - 1):
        node = tree.roots[link]
        while node < tree.roots[link + 1]:
            x, y, z = _at(frames, tree, node)
            excused = tree.floor[link] and tree.leaf[node]
            d = grid_sample(solids, x, y, z)[0]
            if excused and is_floor(solids, -1, d, x, y, z, tolerance):
                d = FAR
            for i in range(len(solids.kind)):
                other = solid_distance(solids, i, x, y, z)
                if not other >= d and not (excused and is_floor(solids, i, other, x, y, z, tolerance)):
                    d = other
            if np.isnan(d):
                return np.nan, link
            if d - tree.radius[node] >= least:
                node = tree.skip[node]
                continue
            if tree.leaf[node]:
                least, where = d - tree.radius[node], link
            node += 1
    return least, where


@njit(cache=True)
def _least_gap(tree: SphereTree, frames: np.ndarray, least: float) -> tuple[float, int, int]:
    """Least gap of any pair of links below a bound, else the bound, and the pair."""
    first, second = 0, 0
    for p in range(len(tree.pairs)):
        one, two = tree.pairs[p]
        a, root, end = tree.roots[one], tree.roots[two], tree.roots[two + 1]
        while a < tree.roots[one + 1]:
            ax, ay, az = _at(frames, tree, a)
            x, y, z = _at(frames, tree, root)
            if _gap(ax, ay, az, x, y, z) - tree.radius[a] - tree.radius[root] >= least:
                a = tree.skip[a]
                continue
            if tree.leaf[a]:
                b = root
                while b < end:
                    x, y, z = _at(frames, tree, b)
                    between = _gap(ax, ay, az, x, y, z) - tree.radius[a] - tree.radius[b]
                    if between >= least:
                        b = tree.skip[b]
                        continue
                    if tree.leaf[b]:
                        least, first, second = between, one, two
                    b += 1
            a += 1
    return least, first, second
