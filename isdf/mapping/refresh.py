"""Writing the distances of a window down: from the nearest seeds, what was seen, and the guessed shares."""

from __future__ import annotations

import numpy as np
from numba import njit

from .evidence import FREE_ABOVE, SURFACE_REACH
from .lattice import FINE, STEP
from .seeds import _voxel

# A cell is refined when interpolation misses one of its middles by more than this [m].
TOLERANCE = 0.004
SLACK = 0.01
GUESS_SLACK = 0.15


@njit(cache=True)
def patch_distance(x, y, z, n, seeds, normals, patch):  # type: ignore[no-untyped-def]
    """Squared distance of a point to a disc of radius `patch` round seed n along its normal, and height above it."""
    a, b, c = x - seeds[n, 0], y - seeds[n, 1], z - seeds[n, 2]
    height = a * normals[n, 0] + b * normals[n, 1] + c * normals[n, 2]
    across = max(0.0, np.sqrt(max(0.0, a * a + b * b + c * c - height * height)) - patch)
    return across * across + height * height, height


@njit(cache=True)
def nearest_patch(i, j, k, step, nearest, seeds, normals, patch, x, y, z):  # type: ignore[no-untyped-def]
    """Distance [m] to the closest patch among the candidates of the nodes around a fine node, and height above it.

    Args:
        i, j, k: fine node, counted from the first node of `nearest`.
        step: fine steps between nodes of `nearest`.
        nearest: (nx, ny, nz) index of the closest seed of every node.
        x, y, z: where the fine node lies [m].
    """
    best, side = 1e30, 1.0
    last = -1
    for a in range(i // step, -(-i // step) + 1):
        for b in range(j // step, -(-j // step) + 1):
            for c in range(k // step, -(-k // step) + 1):
                n = nearest[min(a, nearest.shape[0] - 1), min(b, nearest.shape[1] - 1), min(c, nearest.shape[2] - 1)]
                if n == last:
                    continue
                last = n
                square, height = patch_distance(x, y, z, n, seeds, normals, patch)
                if square < best:
                    best, side = square, height
    return np.sqrt(best), side


@njit(cache=True)
def _state(upper, side, observed, tsdf, evidence, half):  # type: ignore[no-untyped-def]
    """1 in free space, -1 behind a surface that was seen, 0 where neither is known."""
    if observed:
        if abs(tsdf) > half:
            return 1 if tsdf > 0 else -1
        return 1 if side > 0 else -1
    if evidence > FREE_ABOVE:
        return 1
    return 0


@njit(cache=True)
def coarse_values(
    begin, end, offset, step, nearest, seeds, normals, patch, lower, lattice_corner, spacing,
    table, brick_corner, distances, weights, voxel, evidence, share, width, value, confidence, state, gap,
):  # type: ignore[no-untyped-def]
    """Distance and confidence of every coarse node of a window, in place.

    Args:
        begin, end: the window, as array indices of the coarse lattice.
        offset: (3,) the window's first node counted from the first node of `nearest` and `lower`, in coarse nodes.
        step: fine steps between nodes of `nearest`.
        lower: (mx, my, mz) lower bounds of the coarse nodes from the first node of `nearest` on [m].
        state: of the window's nodes, written: 1 free, -1 behind a seen surface, 0 unknown.
        gap: of the window's nodes, written: what is taken off the distance to the closest patch [m].
    """
    ratio = int(round(spacing / voxel))
    half = 0.5 * voxel
    for i in range(begin[0], end[0]):
        for j in range(begin[1], end[1]):
            for k in range(begin[2], end[2]):
                a, b, c = i - begin[0], j - begin[1], k - begin[2]
                gi, gj, gk = lattice_corner[0] + i, lattice_corner[1] + j, lattice_corner[2] + k
                upper, side = nearest_patch(
                    (a + offset[0]) * ratio, (b + offset[1]) * ratio, (c + offset[2]) * ratio, step, nearest,
                    seeds, normals, patch, gi * spacing, gj * spacing, gk * spacing,
                )  # fmt: skip
                tsdf, weight = _voxel(table, brick_corner, distances, weights, gi * ratio, gj * ratio, gk * ratio)
                sign = _state(upper, side, weight > 0, tsdf, evidence[i, j, k], half)
                low = lower[a + offset[0], b + offset[1], c + offset[2]]
                noise = 0.006
                if sign > 0:
                    take = max(0.0, upper - max(low, 0.0)) * share[i, j, k]
                    error = max(0.0, upper - max(low, 0.0)) * np.exp(width[i, j, k])
                elif sign < 0:
                    take, error = 2 * upper, 0.0
                else:
                    low = min(low, 0.0)
                    if upper < SURFACE_REACH * spacing:
                        low = -upper
                    low = max(low, -upper)
                    take = (upper - low) * share[i, j, k]
                    error = max(0.03, (upper - low) * np.exp(width[i, j, k]))
                value[i, j, k] = upper - take
                # The chance that a Laplace-distributed error of this mean is below 5 cm.
                confidence[i, j, k] = int(255 * (1 - np.exp(-0.05 / (error + noise))) + 0.5)
                state[a, b, c], gap[a, b, c] = sign, take


@njit(cache=True)
def _fine_value(
    fi, fj, fk, i, j, k, ti, tj, tk, offset, ratio, step, nearest, seeds, normals, patch, lattice_corner, begin,
    table, brick_corner, distances, weights, voxel, evidence, state, gap, plain,
):  # type: ignore[no-untyped-def]
    """Distance [m] of the fine node (ti, tj, tk) steps into the cell of coarse node (i, j, k) of the window."""
    x, y, z = fi * voxel, fj * voxel, fk * voxel
    upper, side = nearest_patch(
        (i + offset[0]) * ratio + ti, (j + offset[1]) * ratio + tj, (k + offset[2]) * ratio + tk,
        step, nearest, seeds, normals, patch, x, y, z,
    )  # fmt: skip
    tsdf, weight = _voxel(table, brick_corner, distances, weights, fi, fj, fk)
    if weight > 0 and (tsdf if abs(tsdf) > 0.5 * voxel else side) < 0:
        return -upper
    if plain:
        return upper
    # What was looked through, and what is to be taken off, between the corners of the cell.
    seen, total, take, known = 0.0, 0.0, 0.0, 0.0
    unseen, other = 0.0, 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                w = (
                    (ti if a else ratio - ti) * (tj if b else ratio - tj) * (tk if c else ratio - tk)
                ) / ratio**3
                if w <= 0:
                    continue
                total += w
                e = evidence[begin[0] + i + a, begin[1] + j + b, begin[2] + k + c]
                seen += w * e
                if state[i + a, j + b, k + c] > 0:
                    known += w
                    take += w * gap[i + a, j + b, k + c]
                else:
                    other += w
                    unseen += w * gap[i + a, j + b, k + c]
    sign = _state(upper, side, weight > 0, tsdf, seen / total, 0.5 * voxel)
    if sign > 0:
        return upper - (take / known if known > 0 else 0.0)
    if sign < 0:
        return -upper
    return upper - min(2 * upper, unseen / other if other > 0 else take / known)


@njit(cache=True)
def _plain(i, j, k, state, gap):  # type: ignore[no-untyped-def]
    """Whether all corners of a cell lie in free space where nothing is guessed; and how much is guessed at most [m]."""
    plain, most, unknown = True, np.float32(0), 0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                s, g = state[i + a, j + b, k + c], gap[i + a, j + b, k + c]
                if s <= 0 or g > 0:
                    plain = False
                if s == 0:
                    unknown += 1
                if s >= 0:
                    most = max(most, g)
    return plain, most, unknown


@njit(cache=True)
def cells_to_refine(
    begin, end, offset, step, nearest, seeds, normals, patch, lattice_corner, spacing,
    table, brick_corner, distances, weights, voxel, evidence, value, state, gap, block, corrections, refine, stale,
):  # type: ignore[no-untyped-def]
    """Find the cells of a window in which trilinear interpolation misses the middle of an edge, face or cell.

    Args:
        refine: of the window's nodes, written: the cell above the node is to be refined.
        stale: of the window's nodes, written: what is stored of it misses one of its middles, too.
    """
    ratio = int(round(spacing / voxel))
    mid = ratio // 2
    for i in range(end[0] - begin[0] - 1):
        for j in range(end[1] - begin[1] - 1):
            for k in range(end[2] - begin[2] - 1):
                plain, most, unknown = _plain(i, j, k, state, gap)
                refine[i, j, k], stale[i, j, k] = False, False
                if unknown == 8:
                    continue
                number = block[begin[0] + i, begin[1] + j, begin[2] + k]
                for m in range(27):
                    a, b, c = m // 9, (m // 3) % 3, m % 3
                    if a != 1 and b != 1 and c != 1 and number < 0:
                        continue
                    line = 0.0
                    for p in range(2):
                        for q in range(2):
                            for r in range(2):
                                w = (a / 2 if p else 1 - a / 2) * (b / 2 if q else 1 - b / 2) * (c / 2 if r else 1 - c / 2)
                                line += w * value[begin[0] + i + p, begin[1] + j + q, begin[2] + k + r]
                    fine = _fine_value(
                        ratio * (lattice_corner[0] + begin[0] + i) + a * mid,
                        ratio * (lattice_corner[1] + begin[1] + j) + b * mid,
                        ratio * (lattice_corner[2] + begin[2] + k) + c * mid,
                        i, j, k, a * mid, b * mid, c * mid, offset, ratio, step, nearest, seeds, normals, patch,
                        lattice_corner, begin, table, brick_corner, distances, weights, voxel, evidence, state, gap,
                        plain,
                    )  # fmt: skip
                    slack = TOLERANCE + SLACK * abs(line) + GUESS_SLACK * most
                    if abs(fine - line) > slack:
                        refine[i, j, k] = True
                        if number < 0:
                            break
                    if number >= 0:
                        at = a * mid * FINE * FINE + b * mid * FINE + c * mid
                        if abs(line + STEP * corrections[number, at] - fine) > 0.5 * slack:
                            stale[i, j, k] = True
                            if refine[i, j, k]:
                                break


@njit(cache=True)
def fine_values(
    cells, blocks, begin, offset, step, nearest, seeds, normals, patch, lattice_corner, spacing,
    table, brick_corner, distances, weights, voxel, evidence, value, state, gap, corrections,
):  # type: ignore[no-untyped-def]
    """Write the corrections of refined cells: what trilinear interpolation of the corners misses at every fine node."""
    ratio = int(round(spacing / voxel))
    for n in range(len(cells)):
        i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
        plain, _, _ = _plain(i, j, k, state, gap)
        for a in range(FINE):
            for b in range(FINE):
                for c in range(FINE):
                    line = 0.0
                    for p in range(2):
                        for q in range(2):
                            for r in range(2):
                                w = (a if p else ratio - a) * (b if q else ratio - b) * (c if r else ratio - c) / ratio**3
                                line += w * value[begin[0] + i + p, begin[1] + j + q, begin[2] + k + r]
                    fine = _fine_value(
                        ratio * (lattice_corner[0] + begin[0] + i) + a,
                        ratio * (lattice_corner[1] + begin[1] + j) + b,
                        ratio * (lattice_corner[2] + begin[2] + k) + c,
                        i, j, k, a, b, c, offset, ratio, step, nearest, seeds, normals, patch,
                        lattice_corner, begin, table, brick_corner, distances, weights, voxel, evidence, state, gap, plain,
                    )  # fmt: skip
                    steps = (fine - line) / STEP
                    corrections[blocks[n], a * FINE * FINE + b * FINE + c] = int(
                        np.floor(max(-127.0, min(127.0, steps)) + 0.5)
                    )
