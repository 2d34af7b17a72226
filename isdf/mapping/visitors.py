"""What comes into free space and is not seen to stay, such as somebody who walks by, is taken back out of the map.

A camera sees where people were last before they left its view; as far as it knows they stand there for good. So every
brick that something comes into is kept as it was, and given back when nothing was seen in it for a while. What stays in
view in one place is no visitor.

A camera that looks ahead sees no more than the upper half of who stands close to it. Who comes into free space stands
on the floor: what was seen of him goes on down to it, where the image does not show otherwise.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.ndimage import binary_dilation

from .bricks import SIDE, Bricks, BrickVolume
from .departed import looked_past
from .evidence import FREE_ABOVE, INSIDE
from .lately import Lately
from .lattice import Lattice, LatticeArrays, node_at
from .standing import columns, corners, extend_down, feet, vertical

# Seen in one brick for longer than this [s], something has come to stay. Whoever walks is through in two, but may wait
# for a robot for a while.
STAYS = 5.0
# What has come to stay is still told from what always stood there for this long [s].
SETTLES = 10.0
# What is nearer than this to the camera [m] is not taken back unless it has visibly gone: close to its own robot a
# camera sees little.
NEAR = 1.2
# A visitor changes bricks from this far before its surface, the least truncation [m], up to `INSIDE` behind it.
BEFORE = 0.1
# Coarse nodes a side of a brick.
NODES = 2


class Kept(NamedTuple):
    """Bricks as they were before something came.

    Args:
        place: (n, 3) lattice index of each.
        first: (n,) when something was seen in it first [s], inf if it only came near.
        last: (n,) when something was seen in it last, or when it was kept [s].
        past: (n,) when it was seen last that nobody stands in it, see `isdf.mapping.departed` [s], -inf if never.
        distance: (n, 512) float32 [m].
        weight: (n, 512) float32, 0 where nothing was observed.
        ended: (n, 512) float32, see `isdf.mapping.bricks.Bricks`.
        evidence: (n, 2, 2, 2) uint8 of its coarse nodes.
    """

    place: np.ndarray
    first: np.ndarray
    last: np.ndarray
    past: np.ndarray
    distance: np.ndarray
    weight: np.ndarray
    ended: np.ndarray
    evidence: np.ndarray

    def of(self, rows: np.ndarray) -> Kept:
        """Some of them."""
        return Kept(*(values[rows] for values in self))

    def and_also(self, more: Kept) -> Kept:
        """These and others."""
        return Kept(*(np.concatenate(pair) for pair in zip(self, more, strict=True)))


class Visitors:
    """Takes what came and went out of a map again.

    Args:
        bricks: the surfaces.
        lattice: the evidence of free space; two of its nodes a side lie in a brick.
        memory: how long something that is out of view stays in the map [s]; None: for ever.
    """

    def __init__(self, bricks: BrickVolume, lattice: Lattice, memory: float | None) -> None:
        self.bricks, self.lattice, self.memory = bricks, lattice, memory
        self._kept = self._copied(np.empty((0, 3), dtype=np.int64), 0.0)
        self._feet = np.empty((0, 4), dtype=np.int64)
        self._settled = self._kept

    def watch(
        self,
        depth: Float[np.ndarray, "h w"],
        appeared: Bool[np.ndarray, "rows columns"],
        stride: int,
        intrinsics: tuple[float, float, float, float],
        T_world_camera: Float[np.ndarray, "4 4"],
        up: Float[np.ndarray, "3"],
        floor: float,
        now: float,
    ) -> None:
        """Keep what a depth image [m] is about to change in space that was free; call before it is fused.

        Args:
            depth: z-depth, 0 = unknown.
            appeared: which of every `stride`-th pixels show something where space was free.
            stride: in pixels.
            intrinsics: fx, fy, cx, cy.
            T_world_camera: pose.
            up: any vector whose largest component tells the vertical and its sign the way up.
            floor: where the floor is along that axis [m].
            now: time of the image [s].
        """
        self._feet = self._feet[:0]
        if self.memory is None or not (appeared.any() or len(self._kept.place)):
            return
        table, inside = self._table(), self._in_lattice()
        pixels = visited_bricks(
            self.bricks.arrays, self.lattice.arrays, self.lattice.corner, table, self._kept.evidence, depth,
            appeared, stride, intrinsics, T_world_camera,
        )  # fmt: skip
        visited = pixels != 0
        axis, way = vertical(up)
        ground = int(np.floor(floor / self._edge)) - int(self.bricks.corner[axis])
        self._feet = feet(pixels, inside, axis, way, ground)
        visited[tuple(columns(self._feet, axis, way).T)] = True
        # Whoever walks on comes into the neighbours next, little by little: keep those, too.
        near = binary_dilation(visited, np.ones((3, 3, 3), dtype=bool)) & (table < 0) & inside
        self._kept = self._kept.and_also(self._copied(np.argwhere(near) + self.bricks.corner, now))
        rows = self._table()[visited & inside]
        self._kept.first[rows] = np.minimum(self._kept.first[rows], now)
        self._kept.last[rows] = now
        seen = np.isfinite(self._kept.first)
        past = looked_past(self._kept.place, seen, self._edge, depth, intrinsics, T_world_camera, axis)
        self._kept.past[past] = now

    def stand(
        self,
        depth: Float[np.ndarray, "h w"],
        intrinsics: tuple[float, float, float, float],
        T_camera_world: Float[np.ndarray, "4 4"],
        up: Float[np.ndarray, "3"],
    ) -> Float[np.ndarray, "2 3"] | None:
        """Let those who were seen by the last `watch` stand on the floor; call after the image is fused.

        Returns:
            The box [m] that is to be refreshed, None where nothing has changed.
        """
        if len(self._feet) == 0:
            return None
        axis, way = vertical(up)
        under = np.unique(columns(self._feet, axis, way), axis=0)
        self.bricks.add(under[self.bricks.table[tuple(under.T)] < 0])
        extend_down(self.bricks.arrays, self._feet, axis, way, depth, intrinsics, T_camera_world)
        return self._edge * (self.bricks.corner + corners(under))

    def take_back(self, eye: Float[np.ndarray, "3"], now: float) -> Float[np.ndarray, "2 3"] | None:
        """Give back the bricks whose visitors have been out of view for long enough.

        Args:
            eye: where the camera is [m].
            now: [s].

        Returns:
            The box [m] that is to be refreshed, None where nothing has changed.
        """
        kept = self._kept
        if self.memory is None or len(kept.place) + len(self._settled.place) == 0:
            return None
        stayed = kept.last - kept.first > STAYS
        near = np.linalg.norm(self._edge * (kept.place + 0.5) - eye, axis=1) < NEAR
        hidden = near & (kept.past <= kept.last)
        gone = ~stayed & ~hidden & (now - kept.last > self.memory)
        self._kept = kept.of(~stayed & ~gone)
        settled = self._settled.and_also(kept.of(stayed))
        self._settled = settled.of(now - settled.last < SETTLES)
        back = kept.of(gone & np.isfinite(kept.first))
        if len(back.place) == 0:
            return None
        self._give_back(back)
        return self._edge * corners(back.place)

    def lately(self) -> Lately:
        """Where something came and, as far as the camera knows, still is."""
        kept = self._kept.of(np.isfinite(self._kept.first)).and_also(self._settled)
        row = self.bricks.table[tuple((kept.place - self.bricks.corner).T)]
        kept, row = kept.of(row >= 0), row[row >= 0]
        there = self.bricks.weight[row] > 0
        there &= _nearer(self.bricks.distance[row], kept.distance, kept.weight, self.bricks.voxel)
        # Two voxels a side are one cube.
        cubes = there.reshape(-1, *(SIDE // 2, 2) * 3).any(axis=(2, 4, 6))
        brick, *inside = np.nonzero(cubes)
        places = kept.place[brick] * (SIDE // 2) + np.stack(inside, axis=1)
        return Lately.of(places, 2 * self.bricks.voxel)

    @property
    def _edge(self) -> float:
        """Of a brick [m]."""
        return SIDE * self.bricks.voxel

    def _table(self) -> Int[np.ndarray, "nx ny nz"]:
        """Row of every brick that is kept, -1 elsewhere; as large as the table of bricks, which never shrinks."""
        table = np.full(self.bricks.table.shape, -1, dtype=np.int32)
        table[tuple((self._kept.place - self.bricks.corner).T)] = np.arange(len(self._kept.place))
        return table

    def _in_lattice(self) -> Bool[np.ndarray, "nx ny nz"]:
        """Which bricks of the table have their nodes in the lattice."""
        first = self.lattice.corner // NODES - self.bricks.corner
        inside = np.zeros(self.bricks.table.shape, dtype=bool)
        parts = zip(first, first + np.array(self.lattice.shape) // NODES, strict=True)
        inside[tuple(slice(max(0, a), max(0, b)) for a, b in parts)] = True
        return inside

    def _copied(self, place: Int[np.ndarray, "n 3"], now: float) -> Kept:
        """Bricks as they are."""
        count = len(place)
        row = self.bricks.table[tuple((place - self.bricks.corner).T)] if count else np.empty(0, np.int32)
        distance, weight, ended = (np.zeros((count, SIDE**3), dtype=np.float32) for _ in range(3))
        distance[row >= 0] = self.bricks.distance[row[row >= 0]]
        weight[row >= 0] = self.bricks.weight[row[row >= 0]]
        ended[row >= 0] = self.bricks.ended[row[row >= 0]]
        evidence = np.empty((0, NODES, NODES, NODES), dtype=np.uint8)
        if count:
            _, seen, nodes = self._evidence(place)
            evidence = seen[nodes]
        first, last, past = np.full(count, np.inf), np.full(count, float(now)), np.full(count, -np.inf)
        return Kept(place, first, last, past, distance, weight, ended, evidence)

    def _evidence(
        self, place: Int[np.ndarray, "n 3"]
    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
        """First node and evidence of a window that holds some bricks, and where in it their nodes are."""
        begin, end = NODES * place.min(axis=0), NODES * (place.max(axis=0) + 1)
        seen = self.lattice.read("evidence", begin - self.lattice.corner, end - self.lattice.corner)
        first, step = (NODES * place - begin)[:, :, None, None, None], np.indices((NODES,) * 3)
        return begin, seen, tuple(first[:, axis] + step[axis] for axis in range(3))

    def _give_back(self, back: Kept) -> None:
        """Undo what brought surfaces nearer and made space less free; what was learnt of free space stays."""
        row = self.bricks.table[tuple((back.place - self.bricks.corner).T)]
        there = row >= 0
        row, before, weight = row[there], back.distance[there], back.weight[there]
        now = self.bricks.distance[row]
        nearer = _nearer(now, before, weight, self.bricks.voxel)
        self.bricks.distance[row] = np.where(nearer, before, now)
        self.bricks.weight[row] = np.where(nearer, weight, self.bricks.weight[row])
        self.bricks.ended[row] = np.where(nearer, back.ended[there], self.bricks.ended[row])
        begin, seen, nodes = self._evidence(back.place)
        seen[nodes] = np.maximum(seen[nodes], back.evidence)
        begin = begin - self.lattice.corner
        self.lattice.write(begin, begin + seen.shape, evidence=seen)


def _nearer(
    now: Float[np.ndarray, "n 512"],
    before: Float[np.ndarray, "n 512"],
    weight: Float[np.ndarray, "n 512"],
    voxel: float,
) -> Bool[np.ndarray, "n 512"]:
    """Where distances [m] are less than before, by half a voxel [m]; what had no `weight` was not known to be free."""
    return np.where(weight > 0, now < before - 0.5 * voxel, now < BEFORE)


@njit(cache=True, nogil=True)
@no_type_check
def visited_bricks(
    bricks: Bricks, lattice: LatticeArrays, first_node, kept, evidence, depth, appeared, stride, intrinsics, T_wc
):  # fmt: skip
    """How many pixels show something that has come in each brick of the table; -1 where it only hides what is there.

    Args:
        bricks: before the image is fused.
        lattice: likewise.
        first_node: (3,) lattice index of its first node.
        kept: (nx, ny, nz) row of every brick that is kept, -1 elsewhere.
        evidence: (n, 2, 2, 2) of the nodes of those.
        depth, appeared, stride, intrinsics, T_wc: see `Visitors.watch`.
    """
    fx, fy, cx, cy = intrinsics
    R, t = T_wc[:3, :3], T_wc[:3, 3]
    table, corner, edge = bricks.table, bricks.corner, SIDE * bricks.voxel
    out = np.zeros(table.shape, dtype=np.int32)
    ray, point, index = np.empty(3), np.empty(3), np.empty(3, np.int64)
    steps = int(np.ceil((BEFORE + INSIDE) / (0.5 * edge)))
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
                inside &= 0 <= index[axis] < table.shape[axis]
            if not inside:
                continue
            if not appeared[row, column]:
                known = kept[index[0], index[1], index[2]] >= 0
                if not known or not _was_free(lattice, first_node, kept, corner, evidence, point):
                    continue
            out[index[0], index[1], index[2]] = max(out[index[0], index[1], index[2]], 0) + 1
            for n in range(steps + 1):
                w = z - BEFORE + (BEFORE + INSIDE) * n / steps
                inside = True
                for axis in range(3):
                    index[axis] = int(np.floor((t[axis] + w * ray[axis]) / edge)) - corner[axis]
                    inside &= 0 <= index[axis] < table.shape[axis]
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
