"""What distance maps that change voxel by voxel share: a queue of voxels by distance, and the 26 neighbours."""

from __future__ import annotations

import itertools
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

# Ends a list; and the link of a voxel that is in none.
END, IDLE = -1, -2
# Neighbours in lexicographic order, so that number 25 - i lies opposite to number i.
OFFSETS = np.array([o for o in itertools.product((-1, 0, 1), repeat=3) if any(o)], dtype=np.int64)
LENGTHS = np.sqrt((OFFSETS**2).sum(axis=1)).astype(np.float32)


class BucketQueue(NamedTuple):
    """Voxels in the order of a coarse key, each at most once; first in, first out where the keys are equal.

    Args:
        link: (n,) next voxel in the bucket of each voxel, or END, or IDLE where it is not queued.
        heads: (buckets,) first voxel of each bucket.
        tails: (buckets,) last voxel of each.
        lowest: (1,) no bucket before this one holds a voxel.
    """

    link: np.ndarray
    heads: np.ndarray
    tails: np.ndarray
    lowest: np.ndarray


def new_queue(voxels: int, buckets: int) -> BucketQueue:
    """An empty queue for flat voxel indices below `voxels` and keys below `buckets`; greater keys count as the last."""
    heads, tails = (np.full(buckets, END, dtype=np.int32) for _ in range(2))
    link, lowest = np.full(voxels, IDLE, dtype=np.int32), np.full(1, buckets, dtype=np.int64)
    return BucketQueue(link, heads, tails, lowest)


@njit(cache=True, nogil=True)
@no_type_check
def push(queue, voxel, key):
    """Add a voxel unless it is queued; the key it came with first stays."""
    if queue.link[voxel] != IDLE:
        return
    bucket = min(max(int(key), 0), len(queue.heads) - 1)
    queue.link[voxel] = END
    if queue.heads[bucket] == END:
        queue.heads[bucket] = voxel
    else:
        queue.link[queue.tails[bucket]] = voxel
    queue.tails[bucket] = voxel
    queue.lowest[0] = min(queue.lowest[0], bucket)


@njit(cache=True, nogil=True)
@no_type_check
def pop(queue):
    """Take out the first voxel of the lowest bucket; END when the queue is empty."""
    bucket = queue.lowest[0]
    while bucket < len(queue.heads) and queue.heads[bucket] == END:
        bucket += 1
    queue.lowest[0] = bucket
    if bucket == len(queue.heads):
        return END
    voxel = queue.heads[bucket]
    queue.heads[bucket] = queue.link[voxel]
    queue.link[voxel] = IDLE
    return voxel


@njit(cache=True, nogil=True)
@no_type_check
def neighbours(voxel, shape, found):
    """Flat indices of the 26 neighbours, END where they lie outside.

    Args:
        voxel: flat index.
        shape: of the volume.
        found: (26,) int64, filled in the order of `OFFSETS`.
    """
    ny, nz = shape[1], shape[2]
    x, rest = divmod(voxel, ny * nz)
    y, z = divmod(rest, nz)
    inside = 0 < x < shape[0] - 1 and 0 < y < ny - 1 and 0 < z < nz - 1
    for i in range(26):
        dx, dy, dz = OFFSETS[i]
        if inside or (0 <= x + dx < shape[0] and 0 <= y + dy < ny and 0 <= z + dz < nz):
            found[i] = voxel + (dx * ny + dy) * nz + dz
        else:
            found[i] = END
