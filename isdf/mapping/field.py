"""The distance field that answers queries: a two-level lattice of values and confidences."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8, Int16, UInt8
from numba import njit
from torch import Tensor

from ..field import AnalyticField, check_points
from .evidence import FREE_ABOVE
from .interpolation import PARTS, correction, creased, fine_nodes, may_have_crease, trilinear
from .lately import Lately
from .lattice import BLOCK, CHUNK, LatticeArrays, distance_at, node_at

# Below this many points a second thread costs more than it saves.
PARALLEL = 20_000


class LatticeField(AnalyticField):
    """Distances and confidences between the nodes of a lattice; immutable.

    Interpolation is trilinear, but where fine nodes show a crease half way between two surfaces, in free space or in
    something thin: there the field follows both to where they meet (`isdf.mapping.interpolation`). Outside the lattice
    the distance is that of the closest point on its rim, and the gradient across it is zero. Distances beyond 8 m are
    cut off.

    Args:
        table: (cx, cy, cz) row of every chunk of 8 x 8 x 8 coarse nodes, -1 where there is none.
        value: (rows, 512) signed distances at the coarse nodes, in `lattice.UNIT`s.
        confidence: of the same nodes, 255 is 1.
        block: of the same nodes: row of the cell's corrections, -1 where there are none.
        corrections: (n, 125) what trilinear interpolation misses at the fine nodes of a cell, in `lattice.STEP`s.
        evidence: of the same nodes, see `isdf.mapping.evidence`.
        corner: (3,) lattice index of the first node.
        spacing: of coarse nodes [m].
        bounds: (2, 3) lower and upper corner of what was observed [m].
        lately: where something has come into free space.

    The arrays may have rows that belong to the map or to other snapshots: none that this one reads is ever written.
    """

    def __init__(
        self,
        table: Int[np.ndarray, "cx cy cz"],
        value: Int16[np.ndarray, "rows 512"],
        confidence: UInt8[np.ndarray, "rows 512"],
        block: Int[np.ndarray, "rows 512"],
        corrections: Int8[np.ndarray, "n 125"],
        evidence: UInt8[np.ndarray, "rows 512"],
        corner: Int[np.ndarray, "3"],
        spacing: float,
        bounds: Float[Tensor, "2 3"],
        lately: Lately,
    ) -> None:
        self._table, self._value, self._confidence = table, value, confidence
        self._block, self._corrections, self._evidence = block, corrections, evidence
        self._origin, self.spacing = np.asarray(corner) * spacing, float(spacing)
        self.bounds, self._lately = bounds.clone(), lately

    @property
    def nbytes(self) -> int:
        """Memory of all that queries need [bytes]."""
        rows = self._table[self._table >= 0]
        nodes = (
            sum(a.itemsize for a in (self._value, self._confidence, self._block, self._evidence)) * CHUNK**3
        )
        return self._table.nbytes + len(rows) * nodes + int((self._block[rows] >= 0).sum()) * BLOCK

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] and the gradient of the interpolant at world points [m]; no autograd graph."""
        check_points(points)
        flat = points.detach().cpu().numpy().reshape(-1, 3)
        distance, gradient = np.empty(len(flat), np.float32), np.empty((len(flat), 3), np.float32)
        self._split(_query, flat, distance, gradient)
        return (
            torch.from_numpy(distance).to(points).view(points.shape[:-1]),
            torch.from_numpy(gradient).to(points).view(points.shape),
        )

    def confidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Estimated probability that the distance at a world point [m] is wrong by less than 5 cm."""
        check_points(points)
        flat = points.detach().cpu().numpy().reshape(-1, 3)
        out = np.empty(len(flat), np.float32)
        _confidence(flat, self._origin, self.spacing, self._table, self._confidence, out)
        return torch.from_numpy(out).to(points).view(points.shape[:-1])

    def observed(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether space at a world point [m] was looked through: by the closest coarse node, False outside the map."""
        check_points(points)
        flat = points.detach().cpu().numpy().reshape(-1, 3)
        out = np.empty(len(flat), np.bool_)
        _observed(flat, self._origin, self.spacing, self._table, self._evidence, out)
        return torch.from_numpy(out).to(points.device).view(points.shape[:-1])

    def came(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether a surface at a world point [m] belongs to something that came into free space lately.

        It may move on, and its far side was not seen: distances to it are some centimetres less sure than to others.
        Always False in a map that forgets nothing (`MapperConfig.visitors`).
        """
        check_points(points)
        near = self._lately.near(points.detach().cpu().numpy().reshape(-1, 3))
        return torch.from_numpy(near).to(points.device).view(points.shape[:-1])

    def _split(self, kernel: Any, points: np.ndarray, distance: np.ndarray, gradient: np.ndarray) -> None:
        """Run a kernel over the points in as many threads as torch uses."""
        state = (self._origin, self.spacing, self._table, self._value, self._block, self._corrections)
        threads = torch.get_num_threads()
        if threads == 1 or len(points) < PARALLEL:
            kernel(points, *state, distance, gradient)
            return
        parts = zip(*(np.array_split(a, threads) for a in (points, distance, gradient)), strict=True)
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda part: kernel(part[0], *state, *part[1:]), parts))


@njit(cache=True, nogil=True)
@no_type_check
def _query(points, origin, spacing, table, value, block, corrections, distance, gradient):
    """Distances (n,) and gradients (n, 3) of points (n, 3), written in place."""
    nx, ny, nz = CHUNK * table.shape[0], CHUNK * table.shape[1], CHUNK * table.shape[2]
    per = np.float32(1 / spacing)
    parts, apart = np.float32(PARTS), np.float32(spacing / PARTS)
    nodes, rows = np.empty((4, 4, 4), dtype=np.float32), np.empty((4, 4, 2), dtype=np.float32)
    lines = np.empty((4, 3), dtype=np.float32)
    one, two = np.empty((3, 3, 4), dtype=np.float32), np.empty((3, 4, 4), dtype=np.float32)
    owners = np.empty((2, 2, 2), dtype=np.int32)
    for n in range(points.shape[0]):
        x = np.float32((points[n, 0] - origin[0]) / spacing)
        y = np.float32((points[n, 1] - origin[1]) / spacing)
        z = np.float32((points[n, 2] - origin[2]) / spacing)
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            distance[n] = np.nan
            gradient[n, 0], gradient[n, 1], gradient[n, 2] = np.nan, np.nan, np.nan
            continue
        cx = min(max(x, np.float32(0)), np.float32(nx - 1))
        cy = min(max(y, np.float32(0)), np.float32(ny - 1))
        cz = min(max(z, np.float32(0)), np.float32(nz - 1))
        i, j, k = min(int(cx), nx - 2), min(int(cy), ny - 2), min(int(cz), nz - 2)
        tx, ty, tz = cx - np.float32(i), cy - np.float32(j), cz - np.float32(k)
        d, gx, gy, gz = trilinear(
            distance_at(table, value, i, j, k), distance_at(table, value, i, j, k + 1),
            distance_at(table, value, i, j + 1, k), distance_at(table, value, i, j + 1, k + 1),
            distance_at(table, value, i + 1, j, k), distance_at(table, value, i + 1, j, k + 1),
            distance_at(table, value, i + 1, j + 1, k), distance_at(table, value, i + 1, j + 1, k + 1),
            tx, ty, tz,
        )  # fmt: skip
        m = node_at(table, block, i, j, k, np.int32(-1))
        if m >= 0:
            tx, ty, tz = parts * tx, parts * ty, parts * tz
            a, b, c = min(int(tx), PARTS - 1), min(int(ty), PARTS - 1), min(int(tz), PARTS - 1)
            tx, ty, tz = tx - np.float32(a), ty - np.float32(b), tz - np.float32(c)
            e, ex, ey, ez = correction(corrections, m, a, b, c, tx, ty, tz)
            # Farther out than a step, values that bend up do not meet inside of a solid.
            crease = may_have_crease(corrections, m, a, b, c, 1) or (
                d + e < apart and may_have_crease(corrections, m, a, b, c, -1)
            )
            if crease and 0 < i < nx - 2 and 0 < j < ny - 2 and 0 < k < nz - 2:
                fine_nodes(table, value, block, corrections, (i, j, k), (a, b, c), one, two, owners, nodes)
                d, gx, gy, gz = creased(nodes, tx, ty, tz, apart, rows, lines)
                gx, gy, gz = parts * gx, parts * gy, parts * gz
            else:
                d, gx, gy, gz = d + e, gx + parts * ex, gy + parts * ey, gz + parts * ez
        distance[n] = d
        gradient[n, 0] = gx * per if cx == x else 0.0
        gradient[n, 1] = gy * per if cy == y else 0.0
        gradient[n, 2] = gz * per if cz == z else 0.0


@njit(cache=True, nogil=True)
@no_type_check
def _confidence(points, origin, spacing, table, confidence, out):
    """Trilinear confidences (n,) of points (n, 3), 0 outside the lattice and where a point is not finite."""
    nx, ny, nz = CHUNK * table.shape[0], CHUNK * table.shape[1], CHUNK * table.shape[2]
    for n in range(points.shape[0]):
        x = (points[n, 0] - origin[0]) / spacing
        y = (points[n, 1] - origin[1]) / spacing
        z = (points[n, 2] - origin[2]) / spacing
        if not (0 <= x <= nx - 1 and 0 <= y <= ny - 1 and 0 <= z <= nz - 1):
            out[n] = 0.0
            continue
        i, j, k = min(int(x), nx - 2), min(int(y), ny - 2), min(int(z), nz - 2)
        tx, ty, tz = x - i, y - j, z - k
        total = 0.0
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    w = (tx if a else 1 - tx) * (ty if b else 1 - ty) * (tz if c else 1 - tz)
                    total += w * node_at(table, confidence, i + a, j + b, k + c, np.uint8(0))
        out[n] = total / 255


@njit(cache=True, nogil=True)
@no_type_check
def _observed(points, origin, spacing, table, evidence, out):
    """Whether the coarse node closest to each of points (n, 3) was looked through."""
    last = (CHUNK * table.shape[0] - 1, CHUNK * table.shape[1] - 1, CHUNK * table.shape[2] - 1)
    for n in range(points.shape[0]):
        x = (points[n, 0] - origin[0]) / spacing + 0.5
        y = (points[n, 1] - origin[1]) / spacing + 0.5
        z = (points[n, 2] - origin[2]) / spacing + 0.5
        inside = 0 <= x < last[0] + 1 and 0 <= y < last[1] + 1 and 0 <= z < last[2] + 1
        out[n] = inside and node_at(table, evidence, int(x), int(y), int(z), np.uint8(0)) > FREE_ABOVE


@njit(cache=True, nogil=True)
@no_type_check
def query_one(lattice: LatticeArrays, point):
    """Distance [m] at a point (3,) by the coarse nodes; confidence (0 .. 255) and looked through of the closest."""
    at, t = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.float32)
    for axis in range(3):
        place = (point[axis] - lattice.origin[axis]) / lattice.spacing
        if not 0 <= place < CHUNK * lattice.table.shape[axis] - 1:
            return np.float32(0), 0, False
        at[axis] = int(place)
        t[axis] = place - at[axis]
    i, j, k = at
    n, v = lattice.table, lattice.value
    value, _, _, _ = trilinear(
        distance_at(n, v, i, j, k), distance_at(n, v, i, j, k + 1),
        distance_at(n, v, i, j + 1, k), distance_at(n, v, i, j + 1, k + 1),
        distance_at(n, v, i + 1, j, k), distance_at(n, v, i + 1, j, k + 1),
        distance_at(n, v, i + 1, j + 1, k), distance_at(n, v, i + 1, j + 1, k + 1),
        t[0], t[1], t[2],
    )  # fmt: skip
    i, j, k = i + int(t[0] > 0.5), j + int(t[1] > 0.5), k + int(t[2] > 0.5)
    sure = node_at(n, lattice.confidence, i, j, k, np.uint8(0))
    return value, int(sure), node_at(n, lattice.evidence, i, j, k, np.uint8(0)) > 127
