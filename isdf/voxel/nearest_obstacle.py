"""The nearest obstacle of every voxel, kept while obstacles come and go (FIESTA, Han et al., IROS 2019, IV-B)."""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Int, Shaped
from numba import njit

from .wavefront import END, OFFSETS, neighbours, new_queue, pop, push

FAR = np.iinfo(np.int32).max


class Lists(NamedTuple):
    """Doubly linked lists: each obstacle's is of the voxels that it is the nearest obstacle of.

    Args:
        nearest: (voxels,) 1 + flat index of the nearest obstacle, 0 where there is none.
        square: (voxels,) squared distance to it [voxels^2], FAR where there is none.
        first: (voxels,) first member of each obstacle's list, or END.
        before: (voxels,) the member before, or END.
        after: (voxels,) the member after, or END.
    """

    nearest: np.ndarray
    square: np.ndarray
    first: np.ndarray
    before: np.ndarray
    after: np.ndarray


class Changes(NamedTuple):
    """Flat indices of voxels whose state has changed.

    Args:
        inserted: are obstacles now.
        deleted: are none any more.
        fresh: were not mapped before.
    """

    inserted: Int[np.ndarray, "a"]
    deleted: Int[np.ndarray, "b"]
    fresh: Int[np.ndarray, "c"]


class NearestObstacle:
    """The nearest obstacle of every mapped voxel, through mapped voxels.

    Args:
        nearest: (nx, ny, nz) int32, 1 + flat index of the nearest obstacle or 0; changed in place by `update`.
    """

    def __init__(self, nearest: Shaped[np.ndarray, "nx ny nz"]) -> None:
        self.shape, flat = nearest.shape, nearest.reshape(-1)
        self.lists = Lists(flat, *(np.empty(flat.size, dtype=np.int32) for _ in range(4)))
        link_all(self.lists, self.shape)

    @property
    def square(self) -> Int[np.ndarray, "nx ny nz"]:
        """Squared distance to the nearest obstacle [voxels^2]; FAR where there is none."""
        return self.lists.square.reshape(self.shape)

    def update(
        self,
        changes: Changes,
        obstacle: Shaped[np.ndarray, "nx ny nz"],
        mapped: Shaped[np.ndarray, "nx ny nz"],
    ) -> None:
        """Follow changes by wavefronts from where they are.

        Args:
            changes: since the last update.
            obstacle: whether each voxel is one now.
            mapped: whether each voxel is mapped now; no distance is carried through others.
        """
        queue = new_queue(obstacle.size, math.isqrt(sum(n * n for n in self.shape)) + 2)
        insert(changes.inserted, self.lists, queue)
        delete(changes.deleted, self.lists, obstacle.reshape(-1), self.shape, queue)
        for voxel in changes.fresh:
            push(queue, voxel, FAR)
        spread(self.lists, mapped.reshape(-1), self.shape, queue)


@njit(cache=True, nogil=True)
@no_type_check
def _unlink(lists, voxel):
    nearest, square, first, before, after = lists
    if nearest[voxel] == 0:
        return
    if before[voxel] != END:
        after[before[voxel]] = after[voxel]
    else:
        first[nearest[voxel] - 1] = after[voxel]
    if after[voxel] != END:
        before[after[voxel]] = before[voxel]
    nearest[voxel], square[voxel] = 0, FAR


@njit(cache=True, nogil=True)
@no_type_check
def _link(lists, voxel, obstacle, distance):
    nearest, square, first, before, after = lists
    nearest[voxel], square[voxel] = obstacle + 1, distance
    before[voxel], after[voxel] = END, first[obstacle]
    if first[obstacle] != END:
        before[first[obstacle]] = voxel
    first[obstacle] = voxel


@njit(cache=True, nogil=True)
@no_type_check
def _square(a, b, shape):
    """Squared distance of two voxels [voxels^2]."""
    plane = shape[1] * shape[2]
    x = a // plane - b // plane
    y = a % plane // shape[2] - b % plane // shape[2]
    z = a % shape[2] - b % shape[2]
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
@no_type_check
def link_all(lists, shape):
    """Make lists and distances anew from `nearest`."""
    lists.square[:] = FAR
    lists.first[:] = END
    for v in range(lists.nearest.size):
        if lists.nearest[v] > 0:
            obstacle = lists.nearest[v] - 1
            _link(lists, v, obstacle, _square(v, obstacle, shape))


@njit(cache=True, nogil=True)
@no_type_check
def moved(nearest, old_shape, shape, offset):
    """Adapt `nearest` (flat, of the new shape) to a volume that was `old_shape` and has grown by `offset` below."""
    for v in range(nearest.size):
        if nearest[v] > 0:
            rest, z = divmod(nearest[v] - 1, old_shape[2])
            x, y = divmod(rest, old_shape[1])
            nearest[v] = 1 + ((x + offset[0]) * shape[1] + y + offset[1]) * shape[2] + z + offset[2]


@njit(cache=True, nogil=True)
@no_type_check
def insert(inserted, lists, queue):
    """New obstacles are their own nearest."""
    for v in inserted:
        _unlink(lists, v)
        _link(lists, v, v, 0)
        push(queue, v, 0)


@njit(cache=True, nogil=True)
@no_type_check
def delete(deleted, lists, obstacle, shape, queue):
    """Every voxel of a former obstacle's list turns to the best obstacle that still stands of its neighbours'."""
    near = np.empty(26, np.int64)
    for gone in deleted:
        v = lists.first[gone]
        while v != END:
            following = lists.after[v]
            _unlink(lists, v)
            neighbours(v, shape, near)
            best, least = END, FAR
            for i in range(26):
                if near[i] != END and lists.nearest[near[i]] > 0:
                    candidate = lists.nearest[near[i]] - 1
                    if obstacle[candidate]:
                        distance = _square(v, candidate, shape)
                        if distance < least:
                            best, least = candidate, distance
            if best != END:
                _link(lists, v, best, least)
                push(queue, v, np.sqrt(least))
            v = following


@njit(cache=True, nogil=True)
@no_type_check
def spread(lists, mapped, shape, queue):
    """Let every queued voxel ask its neighbours for a nearer obstacle, then tell them of its own, nearest first."""
    near = np.empty(26, np.int64)
    plane = shape[1] * shape[2]
    v = pop(queue)
    while v != END:
        neighbours(v, shape, near)
        mine, least = lists.nearest[v] - 1, lists.square[v]
        if least > 0:
            for i in range(26):
                if near[i] != END and lists.nearest[near[i]] > 0 and lists.nearest[near[i]] - 1 != mine:
                    candidate = lists.nearest[near[i]] - 1
                    distance = _square(v, candidate, shape)
                    if distance < least:
                        mine, least = candidate, distance
            if least < lists.square[v]:
                _unlink(lists, v)
                _link(lists, v, mine, least)
        if mine >= 0:
            x = v // plane - mine // plane
            y = v % plane // shape[2] - mine % plane // shape[2]
            z = v % shape[2] - mine % shape[2]
            for i in range(26):
                n = near[i]
                if n == END or not mapped[n]:
                    continue
                dx, dy, dz = OFFSETS[i]
                distance = (x + dx) ** 2 + (y + dy) ** 2 + (z + dz) ** 2
                if distance < lists.square[n]:
                    _unlink(lists, n)
                    _link(lists, n, mine, distance)
                    push(queue, n, np.sqrt(distance))
        v = pop(queue)
