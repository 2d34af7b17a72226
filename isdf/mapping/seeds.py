"""Surface points between the voxels of a brick volume."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from .bricks import SIDE, VOXELS, Bricks, BrickVolume

# Where space hidden behind the edge of a thing borders on space that another view looks through the distances cross
# zero, too, but no view ends there. With less evidence of a surface than that it is none.
ENDED = 0.3
# Radius of the disc that stands for the surface in a voxel [voxels]: closes most of the gap between neighbours, and
# juts out little over edges.
PATCH = 0.45
# Crossings in a block of so many voxels a side are one patch if their mean normal is this long and none is farther off
# the plane than this [voxels]: flat surfaces are averaged, edges and thin boards stay sharp.
BLOCK = 2
FLAT, OFF = 0.95, 0.4


def kept_seeds(
    volume: BrickVolume, begin: Int[np.ndarray, "3"], end: Int[np.ndarray, "3"]
) -> Float[np.ndarray, "n 8"]:
    """The same as `surface_seeds`, but bricks that have not changed since the last time are not looked at again."""
    store = volume.seeds
    store.fit(volume.count)
    store.put(*_changed_seeds(volume.arrays, begin, end, store.state))
    return _gathered(volume.table, begin, end, store.first, store.number, store.seeds)


@njit(cache=True, nogil=True)
@no_type_check
def surface_seeds(bricks: Bricks, begin, end):
    """Zero crossings between observed neighbours where views end, averaged within blocks that are flat, of a box.

    Args:
        bricks: where to look for them.
        begin: (3,) first brick of the box, as array index.
        end: (3,) one past its last.

    Returns:
        float32 (n, 8): position [m], unit normal towards where each surface was seen from, weight, and radius [m] of
        the disc that stands for it.
    """
    return _changed_seeds(bricks, begin, end, np.full(len(bricks.distance), -1))[3]


@njit(cache=True, nogil=True)
@no_type_check
def _changed_seeds(bricks, begin, end, state):
    """Find the seeds of the bricks of a box whose `_state` is another than `state` (bricks,).

    Returns:
        Row, state now, and number of seeds (m,) of each of these bricks, and their seeds (n, 8) in that order.
    """
    table, corner, distances, weights, ended, voxel, _ = bricks
    # Farther from zero than this no neighbour is across, for distances that change by at most a voxel a voxel or so.
    limit = np.float32(1.8 * voxel)
    size, count, changed = 4096, 0, 0
    out, rows = np.empty((size, 8), np.float32), np.empty((3, len(distances)), np.int64)
    near, few = np.empty((SIDE + 2, SIDE + 2, SIDE + 2), np.float32), np.empty((BLOCK**3, 7), np.float32)
    for bi in range(begin[0], end[0]):
        for bj in range(begin[1], end[1]):
            for bk in range(begin[2], end[2]):
                brick = table[bi, bj, bk]
                if brick < 0:
                    continue
                now = _state(table, bricks.changes, bi, bj, bk)
                if now == state[brick]:
                    continue
                before = count
                if _may_have(distances[brick], ended[brick], limit):
                    if count + VOXELS > size:
                        out = np.concatenate((out, np.empty_like(out)))
                        size *= 2
                    _with_rim(bricks, bi, bj, bk, near)
                    first = (SIDE * (corner[0] + bi), SIDE * (corner[1] + bj), SIDE * (corner[2] + bk))
                    seen = (weights[brick], ended[brick])
                    count = _of_brick(near, *seen, voxel, limit, first, few, out, count)
                rows[0, changed], rows[1, changed], rows[2, changed] = brick, now, count - before
                changed += 1
    return rows[0, :changed].copy(), rows[1, :changed].copy(), rows[2, :changed].copy(), out[:count].copy()


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _state(table, changes, i, j, k):
    """What the seeds of the brick at an array index depend on: how often it and those beside its faces have changed."""
    total = changes[table[i, j, k]]
    for side in (-1, 1):
        x, y, z = _brick(table, i + side, j, k), _brick(table, i, j + side, k), _brick(table, i, j, k + side)
        total += changes[x] if x >= 0 else 0
        total += changes[y] if y >= 0 else 0
        total += changes[z] if z >= 0 else 0
    return total


@njit(cache=True, nogil=True)
@no_type_check
def _gathered(table, begin, end, first, number, seeds):
    """The seeds (n, 8) of the bricks of a box, in its order, from where each brick's are kept."""
    count = 0
    for bi in range(begin[0], end[0]):
        for bj in range(begin[1], end[1]):
            for bk in range(begin[2], end[2]):
                if table[bi, bj, bk] >= 0:
                    count += number[table[bi, bj, bk]]
    out, at = np.empty((count, 8), np.float32), 0
    for bi in range(begin[0], end[0]):
        for bj in range(begin[1], end[1]):
            for bk in range(begin[2], end[2]):
                brick = table[bi, bj, bk]
                if brick >= 0:
                    for n in range(first[brick], first[brick] + number[brick]):
                        for a in range(8):
                            out[at, a] = seeds[n, a]
                        at += 1
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _of_brick(near, weights, ended, voxel, limit, first, few, out, count):
    """Append the seeds of a brick whose first voxel has the lattice index `first`; returns how many there are."""
    for i in range(0, SIDE, BLOCK):
        for j in range(0, SIDE, BLOCK):
            for k in range(0, SIDE, BLOCK):
                found = _crossings(near, weights, ended, voxel, limit, first, i, j, k, few)
                if found > 0:
                    count = _patches(few[:found], voxel, out, count)
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _with_rim(bricks, bi, bj, bk, out):
    """Write the distances (10, 10, 10) of a brick and of the voxels beside its faces, NaN where none was observed."""
    table, distances, weights = bricks.table, bricks.distance, bricks.weight
    brick, nan = table[bi, bj, bk], np.float32(np.nan)
    for i in range(SIDE):
        for j in range(SIDE):
            for k in range(SIDE):
                at = (i * SIDE + j) * SIDE + k
                out[i + 1, j + 1, k + 1] = distances[brick, at] if weights[brick, at] > 0 else nan
    for side in range(2):
        rim, last = (SIDE + 1) * side, (SIDE - 1) * (1 - side)
        x, y, z = (
            _brick(table, bi + 2 * side - 1, bj, bk),
            _brick(table, bi, bj + 2 * side - 1, bk),
            _brick(table, bi, bj, bk + 2 * side - 1),
        )
        for p in range(SIDE):
            for q in range(SIDE):
                at = (last * SIDE + p) * SIDE + q
                out[rim, p + 1, q + 1] = distances[x, at] if x >= 0 and weights[x, at] > 0 else nan
                at = (p * SIDE + last) * SIDE + q
                out[p + 1, rim, q + 1] = distances[y, at] if y >= 0 and weights[y, at] > 0 else nan
                at = (p * SIDE + q) * SIDE + last
                out[p + 1, q + 1, rim] = distances[z, at] if z >= 0 and weights[z, at] > 0 else nan


@njit(cache=True, nogil=True)
@no_type_check
def _brick(table, i, j, k):
    """Number of the brick at an array index of the table, -1 where there is none."""
    inside = 0 <= i < table.shape[0] and 0 <= j < table.shape[1] and 0 <= k < table.shape[2]
    return table[i, j, k] if inside else np.int32(-1)


@njit(cache=True, nogil=True)
@no_type_check
def _may_have(distances, ended, limit):
    """Whether any voxel (512,) of a brick is near enough to a surface that views end at; made to be vectorised."""
    some = False
    for at in range(VOXELS):
        some |= (abs(distances[at]) <= limit) & (ended[at] >= np.float32(ENDED))
    return some


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _crossings(near, weights, ended, voxel, limit, first, i, j, k, out):
    """Write position, normal and weight (7,) of the surface in each voxel of a block; returns how many have one."""
    found = 0
    for a in range(i, i + BLOCK):
        for b in range(j, j + BLOCK):
            for c in range(k, k + BLOCK):
                here, at = near[a + 1, b + 1, c + 1], (a * SIDE + b) * SIDE + c
                if not abs(here) <= limit or ended[at] < ENDED:
                    continue
                x, sx, cx = _across(near[a, b + 1, c + 1], here, near[a + 2, b + 1, c + 1])
                y, sy, cy = _across(near[a + 1, b, c + 1], here, near[a + 1, b + 2, c + 1])
                z, sz, cz = _across(near[a + 1, b + 1, c], here, near[a + 1, b + 1, c + 2])
                crossings, length = cx + cy + cz, np.sqrt(sx * sx + sy * sy + sz * sz)
                if crossings == 0 or length <= 0:
                    continue
                out[found, 0] = voxel * (first[0] + a + x / crossings)
                out[found, 1] = voxel * (first[1] + b + y / crossings)
                out[found, 2] = voxel * (first[2] + c + z / crossings)
                out[found, 3], out[found, 4], out[found, 5] = sx / length, sy / length, sz / length
                out[found, 6] = weights[at]
                found += 1
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _across(before, here, after):
    """Along an axis: where distances cross zero within half a voxel (summed), their slope, and how often they do."""
    shift, slope, crossings, known = np.float32(0), np.float32(0), 0, 0
    if before == before:  # NaN is not
        known += 1
        slope += here - before
        if (here < 0) != (before < 0) and here / (here - before) <= 0.5:
            shift -= here / (here - before)
            crossings += 1
    if after == after:
        known += 1
        slope += after - here
        if (here < 0) != (after < 0) and here / (here - after) <= 0.5:
            shift += here / (here - after)
            crossings += 1
    return shift, slope / np.float32(max(1, known)), crossings


@njit(cache=True, nogil=True)
@no_type_check
def _patches(few, voxel, out, count):
    """Append the crossings (n, 7) of a block, or their mean where they lie in a plane; returns how many there are."""
    n = len(few)
    mean = np.zeros(7, np.float32)
    for m in range(n):
        for a in range(7):
            mean[a] += few[m, a] / n
    length = np.sqrt(mean[3] ** 2 + mean[4] ** 2 + mean[5] ** 2)
    flat = length > FLAT
    for m in range(n):
        off = 0.0
        for a in range(3):
            off += (few[m, a] - mean[a]) * mean[3 + a]
        flat &= abs(off) <= OFF * voxel
    if flat:
        mean[3:6] /= length
        out[count, :7] = mean
        out[count, 7] = PATCH * voxel * np.sqrt(n)
        return count + 1
    for m in range(n):
        out[count, :7] = few[m]
        out[count, 7] = PATCH * voxel
        count += 1
    return count
