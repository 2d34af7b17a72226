"""Where a depth image shows something that has come into space known to be free."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from .evidence import FREE_ABOVE, INSIDE
from .lattice import LatticeArrays, node_at


@njit(cache=True, nogil=True)
@no_type_check
def visited_places(
    edge, corner, before, lattice: LatticeArrays, first_node, kept, evidence, depth, appeared, stride, intrinsics, T_wc
):  # fmt: skip
    """How many pixels show something that has come in each place; -1 where it only hides what is there.

    Args:
        edge: of a place [m].
        corner: (3,) index of the first.
        before: see `isdf.mapping.visitors.Visitors` [m].
        lattice: before the image is fused.
        first_node: (3,) lattice index of its first node.
        kept: (nx, ny, nz) row of every place that is kept, -1 elsewhere.
        evidence: (n, 2, 2, 2) of the nodes of those.
        depth, appeared, stride, intrinsics, T_wc: see there, `watch`.
    """
    fx, fy, cx, cy = intrinsics
    R, t = T_wc[:3, :3], T_wc[:3, 3]
    out = np.zeros(kept.shape, dtype=np.int32)
    ray, point, index = np.empty(3), np.empty(3), np.empty(3, np.int64)
    steps = int(np.ceil((before + INSIDE) / (0.5 * edge)))
    for row in range(appeared.shape[0]):
        for column in range(appeared.shape[1]):
            v, u = row * stride, column * stride
            z = depth[v, u]
            if z <= 0:
                continue
            a, b = (u - cx) / fx, (v - cy) / fy
            inside = True
            for axis in range(3):
                ray[axis] = R[axis, 0] * a + R[axis, 1] * b + R[axis, 2]
                point[axis] = t[axis] + z * ray[axis]
                index[axis] = int(np.floor(point[axis] / edge)) - corner[axis]
                inside &= 0 <= index[axis] < kept.shape[axis]
            if not inside:
                continue
            if not appeared[row, column]:
                known = kept[index[0], index[1], index[2]] >= 0
                if not known or not _was_free(lattice, first_node, kept, corner, evidence, point):
                    continue
            out[index[0], index[1], index[2]] = max(out[index[0], index[1], index[2]], 0) + 1
            for n in range(steps + 1):
                w = z - before + (before + INSIDE) * n / steps
                inside = True
                for axis in range(3):
                    index[axis] = int(np.floor((t[axis] + w * ray[axis]) / edge)) - corner[axis]
                    inside &= 0 <= index[axis] < kept.shape[axis]
                if inside and out[index[0], index[1], index[2]] == 0:
                    out[index[0], index[1], index[2]] = -1
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _was_free(lattice, first_node, kept, corner, evidence, point):
    """Whether all nodes round a point were seen to be free before anything came."""
    shape = lattice.table.shape
    n = np.floor(point / lattice.spacing).astype(np.int64)
    for corner_of_cell in range(8):
        i = n[0] + (corner_of_cell >> 2)
        j = n[1] + ((corner_of_cell >> 1) & 1)
        k = n[2] + (corner_of_cell & 1)
        a, b, c = (i >> 1) - corner[0], (j >> 1) - corner[1], (k >> 1) - corner[2]
        row = -1
        if 0 <= a < kept.shape[0] and 0 <= b < kept.shape[1] and 0 <= c < kept.shape[2]:
            row = kept[a, b, c]
        if row >= 0:
            free = evidence[row, i & 1, j & 1, k & 1] > FREE_ABOVE
        else:
            x, y, z = i - first_node[0], j - first_node[1], k - first_node[2]
            if x < 0 or y < 0 or z < 0 or x >= 8 * shape[0] or y >= 8 * shape[1] or z >= 8 * shape[2]:
                return False
            free = node_at(lattice.table, lattice.evidence, x, y, z, 0) > FREE_ABOVE
        if not free:
            return False
    return True
