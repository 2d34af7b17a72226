"""How clear each of many states is: least clearance from solids and least gap between links."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from planning.compiled.kinematics import poses
from planning.compiled.solids import FAR, FLOOR_SLOPE, beyond, grid_sample, solid_distance, solid_is_floor
from planning.compiled.states import World, at, gap


@njit(cache=True, nogil=True)
@no_type_check
def measure(
    world: World, states: np.ndarray, order: np.ndarray, floor: float, self_floor: float, widest: float
):
    """Clearance, its link, self-collision gap and its pair for every state (n, dof), visited in an order.

    Values are exact where they are the least so far or below their floor [m], and upper bounds elsewhere; gaps are
    cut off at `widest`. NaN where the solids' distance is.
    """
    n, tree = len(states), world.tree
    depth, link = np.empty(n), np.zeros(n, np.int64)
    gaps, pair = np.empty(n), np.zeros((n, 2), np.int64)
    least, narrowest = np.inf, widest
    for s in order:
        frames = poses(world.chain, states[s])
        depth[s], link[s] = _clearance(world, frames, max(least, floor))
        least = min(least, depth[s])
        bound = min(max(narrowest, self_floor), widest)
        gaps[s], pair[s, 0], pair[s, 1] = _least_gap(
            tree.ball, tree.walk, tree.roots, tree.pairs, frames, bound
        )
        narrowest = min(narrowest, gaps[s])
    return depth, link, gaps, pair


@njit(cache=True, nogil=True)
@no_type_check
def _clearance(world: World, frames: np.ndarray, least: float) -> tuple[float, int]:
    """Least clearance of any leaf below a bound, else the bound, and the link that has it."""
    ball, walk, solids, table = world.tree.ball, world.tree.walk, world.solids, world.solids.table
    where = 0
    for link in range(len(world.tree.roots) - 1):
        node, end, floor = world.tree.roots[link], world.tree.roots[link + 1], world.tree.floor[link]
        while node < end:
            x, y, z = at(frames, ball, walk, node)
            radius, leaf = ball[node, 3], walk[node, 2] == 1
            d = FAR
            if len(solids.grid) > 0:
                d, _, _, up = grid_sample(solids, x, y, z)
                if floor and leaf and abs(d - z) <= world.floor_tolerance and up > FLOOR_SLOPE:
                    d = FAR
            for i in range(len(table)):
                if beyond(table, i, x, y, z, max(min(d, least + radius), 0.0)):
                    continue
                other = solid_distance(table, i, x, y, z)
                excused = floor and leaf and solid_is_floor(table, i, other, x, y, z, world.floor_tolerance)
                if not other >= d and not excused:
                    d = other
            if np.isnan(d):
                return np.nan, link
            if d - radius >= least:
                node = walk[node, 1]
                continue
            if leaf:
                least, where = d - radius, link
            node += 1
    return least, where


@njit(cache=True, nogil=True)
@no_type_check
def _least_gap(
    ball: np.ndarray, walk: np.ndarray, roots: np.ndarray, pairs: np.ndarray, frames: np.ndarray, least: float
) -> tuple[float, int, int]:
    """Least gap of any pair of links below a bound, else the bound, and the pair."""
    first, second = 0, 0
    for p in range(len(pairs)):
        a, root, end = roots[pairs[p, 0]], roots[pairs[p, 1]], roots[pairs[p, 1] + 1]
        x, y, z = at(frames, ball, walk, root)
        while a < roots[pairs[p, 0] + 1]:
            ax, ay, az = at(frames, ball, walk, a)
            if gap(ax, ay, az, x, y, z) - ball[a, 3] - ball[root, 3] >= least:
                a = walk[a, 1]
                continue
            b = root
            while walk[a, 2] == 1 and b < end:
                bx, by, bz = at(frames, ball, walk, b)
                between = gap(ax, ay, az, bx, by, bz) - ball[a, 3] - ball[b, 3]
                if between >= least:
                    b = walk[b, 1]
                    continue
                if walk[b, 2] == 1:
                    least, first, second = between, pairs[p, 0], pairs[p, 1]
                b += 1
            a += 1
    return least, first, second
