"""RRT-Connect (Kuffner and LaValle, ICRA 2000) and shortcuts of its path, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from planning.compiled.states import World, edge_free, free, motion

SHORTER = 0.25  # of an edge that is blocked is tried before it is given up


class Trees(NamedTuple):
    """Two trees of free configurations: `nodes` (2, m, dof), their `parents` (2, m), and how many there are (2,)."""

    nodes: np.ndarray
    parents: np.ndarray
    sizes: np.ndarray


def planted(start: np.ndarray, goal: np.ndarray, max_nodes: int) -> Trees:
    """A tree at the start and one at the goal, each with room for `max_nodes`."""
    nodes = np.empty((2, max_nodes, len(start)))
    nodes[0, 0], nodes[1, 0] = start, goal
    return Trees(nodes, np.zeros((2, max_nodes), np.int64), np.ones(2, np.int64))


@njit(cache=True, nogil=True)
@no_type_check
def grow(
    world: World, trees: Trees, rng: np.random.Generator, reach: float, resolution: float, samples: int
) -> np.ndarray:
    """A free path (k, dof) from one root to the other, both free; (0, dof) after so many samples in vain.

    Two trees grow in turn: one by an edge of at most `reach` (weighted length [m]) towards a sample, the other then
    edge by edge towards what was added. Call again with the same trees to go on.
    """
    nodes, parents, sizes = trees
    dof, max_nodes = nodes.shape[2], nodes.shape[1]
    side = 0
    sample = np.empty(dof)
    for _ in range(samples):
        for j in range(dof):
            sample[j] = world.low[j] + (world.high[j] - world.low[j]) * rng.random()
        if sizes[side] > sizes[1 - side]:  # grow the smaller tree: the other is in the open
            side = 1 - side
        if sizes.max() >= max_nodes - 1:
            break
        near = _nearest(world, nodes[side], sizes[side], sample)
        new = _steered(world, nodes[side, near], sample, reach)
        blocked = not edge_free(world, nodes[side, near], new, resolution)
        if blocked:  # out of a narrow place by a shorter edge
            new = nodes[side, near] + SHORTER * (new - nodes[side, near])
            blocked = not edge_free(world, nodes[side, near], new, resolution)
        if blocked:
            side = 1 - side
            continue
        here = _added(nodes[side], parents[side], sizes, side, new, near)
        other = 1 - side
        there = _nearest(world, nodes[other], sizes[other], new)
        while sizes[other] < max_nodes:
            step = _steered(world, nodes[other, there], new, reach)
            if not edge_free(world, nodes[other, there], step, resolution):
                break
            if np.array_equal(step, new):
                return _joined(nodes, parents, side, here, there)
            there = _added(nodes[other], parents[other], sizes, other, step, there)
        side = other
    return np.empty((0, dof))


@njit(cache=True, nogil=True)
@no_type_check
def _nearest(world: World, nodes: np.ndarray, size: int, q: np.ndarray) -> int:
    best, where = np.inf, 0
    for i in range(size):
        total = 0.0
        for j in range(len(q)):
            step = (nodes[i, j] - q[j]) * world.weights[j]
            total += step * step
        if total < best:
            best, where = total, i
    return where


@njit(cache=True, nogil=True)
@no_type_check
def _steered(world: World, origin: np.ndarray, towards: np.ndarray, reach: float) -> np.ndarray:
    """`towards` itself, or the point on the way there as far off as an edge may reach."""
    length = motion(world, origin, towards)
    if length <= reach:
        return towards.copy()
    return origin + (towards - origin) * (reach / length)


@njit(cache=True, nogil=True)
@no_type_check
def _added(
    nodes: np.ndarray, parents: np.ndarray, sizes: np.ndarray, side: int, q: np.ndarray, parent: int
) -> int:
    at = sizes[side]
    nodes[at] = q
    parents[at] = parent
    sizes[side] += 1
    return at


@njit(cache=True, nogil=True)
@no_type_check
def _joined(nodes: np.ndarray, parents: np.ndarray, side: int, here: int, there: int) -> np.ndarray:
    """The path from the first tree's root over the meeting point to the second's."""
    ends = (here, there) if side == 0 else (there, here)
    lengths = np.ones(2, np.int64)
    for tree in range(2):
        i = ends[tree]
        while i != 0:
            i = parents[tree, i]
            lengths[tree] += 1
    path = np.empty((lengths[0] + lengths[1], nodes.shape[2]))
    i = ends[0]
    for k in range(lengths[0] - 1, -1, -1):
        path[k] = nodes[0, i]
        i = parents[0, i]
    i = ends[1]
    for k in range(lengths[1]):
        path[lengths[0] + k] = nodes[1, i]
        i = parents[1, i]
    return path


@njit(cache=True, nogil=True)
@no_type_check
def length(path: np.ndarray) -> float:
    """Sum of the Euclidean lengths of a path's edges [rad | m]."""
    total = 0.0
    for i in range(len(path) - 1):
        total += math.sqrt(np.sum((path[i + 1] - path[i]) ** 2))
    return total


@njit(cache=True, nogil=True)
@no_type_check
def shorten(
    world: World, path: np.ndarray, rng: np.random.Generator, resolution: float, rounds: int
) -> np.ndarray:
    """Replace stretches of a free path by straight motions where these are free and shorter.

    By turns between two vertices, between two points anywhere, and of a single joint while the others move on as they
    did (partial shortcuts, Geraerts and Overmars 2007).
    """
    for k in range(rounds):
        if len(path) == 2:
            break
        arc = np.zeros(len(path))
        for i in range(1, len(path)):
            arc[i] = arc[i - 1] + math.sqrt(np.sum((path[i] - path[i - 1]) ** 2))
        a, b = rng.random() * arc[-1], rng.random() * arc[-1]
        if k % 3 == 0:  # vertices, of which those in between vanish
            a, b = arc[int(rng.random() * len(path))], arc[int(rng.random() * len(path))]
        if a > b:
            a, b = b, a
        i = min(np.searchsorted(arc, a, side="right") - 1, len(path) - 2)
        j = min(np.searchsorted(arc, b, side="right") - 1, len(path) - 2)
        if i == j:
            continue
        first = path[i] + (path[i + 1] - path[i]) * ((a - arc[i]) / (arc[i + 1] - arc[i]))
        last = path[j] + (path[j + 1] - path[j]) * ((b - arc[j]) / (arc[j + 1] - arc[j]))
        if k % 3 == 2:
            joint = int(rng.random() * path.shape[1])
            stretch = _one_joint_straight(path[i : j + 2], arc[i : j + 2], first, last, a, b, joint)
        else:
            stretch = np.empty((2, path.shape[1]))
            stretch[0], stretch[1] = first, last
        if b - a - length(stretch) > 1e-6 and _path_free(world, stretch, resolution):
            path = _spliced(path, i, j, stretch)
    return path


@njit(cache=True, nogil=True)
@no_type_check
def _one_joint_straight(
    path: np.ndarray, arc: np.ndarray, first: np.ndarray, last: np.ndarray, a: float, b: float, joint: int
) -> np.ndarray:
    """The stretch from arc length a to b of a path, with one joint moving evenly."""
    out = np.empty((len(path), path.shape[1]))
    out[0], out[-1] = first, last
    for k in range(1, len(path) - 1):
        out[k] = path[k]
        out[k, joint] = first[joint] + (last[joint] - first[joint]) * ((arc[k] - a) / (b - a))
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _path_free(world: World, path: np.ndarray, resolution: float) -> bool:
    if not free(world, path[0]):
        return False
    for k in range(len(path) - 1):  # noqa: SIM110  (numba has no all)
        if not edge_free(world, path[k], path[k + 1], resolution):
            return False
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _spliced(path: np.ndarray, i: int, j: int, stretch: np.ndarray) -> np.ndarray:
    """Path up to vertex i, a stretch, and from vertex j + 1 on, without repeated points."""
    n = len(stretch)
    out = np.empty((i + 1 + n + len(path) - j - 1, path.shape[1]))
    out[: i + 1] = path[: i + 1]
    out[i + 1 : i + 1 + n] = stretch
    out[i + 1 + n :] = path[j + 1 :]
    keep = 1
    for k in range(1, len(out)):
        if np.sum((out[k] - out[keep - 1]) ** 2) > 1e-18:
            out[keep] = out[k]
            keep += 1
    out[keep - 1] = path[-1]
    return out[:keep]
