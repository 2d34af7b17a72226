"""Interpolation between the nodes of the lattice, with creases: distances have them half way between two surfaces."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from .lattice import FINE, STEP, distance_at, node_at

# Fine cells a side of a refined cell.
PARTS = FINE - 1
# Below this second difference along an axis, in steps of the corrections, a bend is taken for noise, and the field may
# jump by half of it between fine cells of which one has a crease.
BEND = 4
# Solids thinner than this [m] may be missed between two nodes: lines that do not meet half as deep inside are raised by
# so many times what is lacking. Meeting on a surface, they are above any chord then, which is half a fine step at most.
THINNEST, LIFT = 0.005, 8
# No distance changes faster than one moves: nodes that differ by so much more than they are apart are not followed.
STEEPEST = 1.25


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def trilinear(v000, v001, v010, v011, v100, v101, v110, v111, x, y, z):
    """Value of trilinear interpolation at (x, y, z) in [0, 1]^3 and its three derivatives."""
    a00, a01, a10, a11 = v001 - v000, v011 - v010, v101 - v100, v111 - v110
    e00, e01, e10, e11 = v000 + a00 * z, v010 + a01 * z, v100 + a10 * z, v110 + a11 * z
    b0, b1 = e01 - e00, e11 - e10
    f0, f1 = e00 + b0 * y, e10 + b1 * y
    z0, z1 = a00 + (a01 - a00) * y, a10 + (a11 - a10) * y
    return f0 + (f1 - f0) * x, f1 - f0, b0 + (b1 - b0) * x, z0 + (z1 - z0) * x


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def crease(a, b, c, d, t, apart):
    """Which line to follow at t in [0, 1] between b and c, of four distances in a row, at nodes so far apart [m].

    Where the lines through the first two and through the last two both pass above the chord from b to c, they are the
    distances of two surfaces, and the lower of them holds: a ridge, f = max(chord, min(left, right)). Inside of solids
    it is the other way round, a valley: f = min(chord, max(left, right)). So solids too thin to hold a node are found.
    Outside, values bend up beside the edges of things, but lines meet above zero there; those are raised until the
    chord is lower. That is exact for two planes (compare the subcell resolution of Harten, 1989), and continuous, but
    where neighbours begin to differ by more than distances can: there the chord holds.

    Returns:
        which pair of neighbours the line goes through (0, 1 or 2), how far along from the first of them t is, and by
        how much the line is raised [m].
    """
    one, zero = np.float32(1), np.float32(0)
    if max(abs(b - a), abs(d - c)) > np.float32(STEEPEST) * apart:
        return 1, t, zero
    chord, left, right = b + t * (c - b), b + t * (b - a), c - (one - t) * (d - c)
    if min(left, right) > chord:
        return (0, t + one, zero) if left < right else (2, t - one, zero)
    if max(left, right) < chord:
        before, after = b - a, d - c
        meet = b + before * (b + after - c) / max(after - before, np.float32(1e-9))
        lift = np.float32(LIFT) * max(zero, meet + np.float32(THINNEST / 2))
        if max(left, right) + lift < chord:
            return (0, t + one, lift) if left > right else (2, t - one, lift)
    return 1, t, zero


@njit(cache=True, nogil=True)
@no_type_check
def creased(nodes, x, y, z, apart, rows, lines):
    """Interpolation of 4 x 4 x 4 nodes in the cell in their middle, with creases: along z, then y, then x.

    Args:
        nodes: (4, 4, 4) distances by x, y, z [m].
        x: place in the middle cell, in [0, 1]; so are
        y: and
        z: this.
        apart: distance between nodes [m].
        rows: (4, 4, 2) to work in, and
        lines: (4, 3), too.

    Returns:
        value and its derivatives by x, y and z, those of the lines it follows; what raises a line counts as constant.
    """
    for i in range(4):
        for j in range(4):
            v = nodes[i, j]
            n, t, lift = crease(v[0], v[1], v[2], v[3], z, apart)
            slope = v[n + 1] - v[n]
            rows[i, j, 0], rows[i, j, 1] = v[n] + t * slope + lift, slope
    for i in range(4):
        v = rows[i]
        n, t, lift = crease(v[0, 0], v[1, 0], v[2, 0], v[3, 0], y, apart)
        slope = v[n + 1, 0] - v[n, 0]
        lines[i, 0], lines[i, 1] = v[n, 0] + t * slope + lift, slope
        lines[i, 2] = v[n, 1] + t * (v[n + 1, 1] - v[n, 1])
    n, t, lift = crease(lines[0, 0], lines[1, 0], lines[2, 0], lines[3, 0], x, apart)
    a, b = lines[n], lines[n + 1]
    slope = b[0] - a[0]
    return a[0] + t * slope + lift, slope, a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def correction(corrections, m, a, b, c, x, y, z):
    """What to add to interpolation of the coarse nodes in fine cell a, b, c of refined cell m, and its derivatives.

    Args:
        corrections: of the lattice.
        m: the refined cell's row.
        a: which of its fine cells, 0 .. 3 along each axis; so are
        b: and
        c: this.
        x: place in the fine cell, in [0, 1]; so are
        y: and
        z: this.
    """
    f, n, s, scale = corrections, (a * FINE + b) * FINE + c, FINE * FINE, np.float32(STEP)
    e, ex, ey, ez = trilinear(
        np.float32(f[m, n]), np.float32(f[m, n + 1]),
        np.float32(f[m, n + FINE]), np.float32(f[m, n + FINE + 1]),
        np.float32(f[m, n + s]), np.float32(f[m, n + s + 1]),
        np.float32(f[m, n + s + FINE]), np.float32(f[m, n + s + FINE + 1]),
        x, y, z,
    )  # fmt: skip
    return scale * e, scale * ex, scale * ey, scale * ez


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def may_have_crease(corrections, m, a, b, c, way):
    """Whether values bend at both ends of an edge of fine cell a, b, c of refined cell m, as far as it can tell.

    They bend down if `way` is 1, up if it is -1. Straight lines between the coarse nodes do not bend, so corrections
    tell. Ends on its rim bend by what lies beyond.
    """
    at = (a * FINE + b) * FINE + c
    return (
        _bends(corrections, m, at, a, FINE * FINE, FINE, 1, way)
        or _bends(corrections, m, at, b, FINE, FINE * FINE, 1, way)
        or _bends(corrections, m, at, c, 1, FINE * FINE, FINE, way)
    )


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _bends(f, m, at, part, along, aside, over, way):
    """Whether any of the four edges in one direction does; neighbours along and across them are so far apart."""
    found = False
    for u in range(2):
        for v in range(2):
            n = at + u * aside + v * over
            slope = f[m, n + along] - f[m, n]
            low = part == 0 or way * (f[m, n] - f[m, n - along] - slope) > BEND
            high = part == PARTS - 1 or way * (slope - f[m, n + 2 * along] + f[m, n + along]) > BEND
            found |= low and high
    return found


@njit(cache=True, nogil=True)
@no_type_check
def fine_nodes(table, value, block, corrections, cell, part, one, two, rows, out):
    """Values of the 4 x 4 x 4 fine nodes about one of the fine cells of a refined cell.

    Args:
        table: of the lattice; so are
        value: and
        block: and
        corrections: this.
        cell: (3,) the refined cell, by its first coarse node; not on the rim of the lattice.
        part: (3,) which of its fine cells, 0 .. 3 along each axis.
        one: (3, 3, 4) to work in, and
        two: (3, 4, 4) and
        rows: (2, 2, 2) int32, too.
        out: (4, 4, 4) written [m], by x, y, z.
    """
    # Along each axis they lie in cells i and i + 1, say, of which i + p is the one in the middle; or all in cell i.
    i, p, nx = _cells_about(cell[0], part[0])
    j, q, ny = _cells_about(cell[1], part[1])
    k, r, nz = _cells_about(cell[2], part[2])
    # Place of the first of them in fine steps from the first coarse node.
    x, y, z = part[0] - 1 + PARTS * p, part[1] - 1 + PARTS * q, part[2] - 1 + PARTS * r
    per, parts, scale = np.float32(1 / PARTS), np.float32(PARTS), np.float32(STEP)
    for a in range(nx + 1):
        for b in range(ny + 1):
            v0, v1 = (
                distance_at(table, value, i + a, j + b, k),
                distance_at(table, value, i + a, j + b, k + 1),
            )
            v2 = distance_at(table, value, i + a, j + b, k + 2) if nz > 1 else v1
            for w in range(4):
                n = np.float32(z + w)
                one[a, b, w] = v0 + per * n * (v1 - v0) if n <= parts else v1 + per * (n - parts) * (v2 - v1)
    for a in range(nx + 1):
        for v in range(4):
            b = int(y + v > PARTS)
            t = per * np.float32(y + v - PARTS * b)
            for w in range(4):
                two[a, v, w] = one[a, b, w] + t * (one[a, b + 1, w] - one[a, b, w])
    for a in range(nx):
        for b in range(ny):
            for c in range(nz):
                rows[a, b, c] = node_at(table, block, i + a, j + b, k + c, np.int32(-1))
    # A node that two cells share belongs to the one in the middle.
    for u in range(4):
        a = int(x + u > PARTS - p)
        t = per * np.float32(x + u - PARTS * a)
        for v in range(4):
            b = int(y + v > PARTS - q)
            at = ((x + u - PARTS * a) * FINE + y + v - PARTS * b) * FINE + z
            for w in range(4):
                c = int(z + w > PARTS - r)
                f, m = two[a, v, w] + t * (two[a + 1, v, w] - two[a, v, w]), rows[a, b, c]
                out[u, v, w] = f + scale * np.float32(corrections[m, at + w - PARTS * c]) if m >= 0 else f


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _cells_about(cell, part):
    """First cell along an axis that four nodes about a part lie in, how far before the cell it is, and how many."""
    if part == 0:
        return cell - 1, 1, 2
    return cell, 0, 2 if part == PARTS - 1 else 1
