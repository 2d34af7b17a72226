"""What comes into free space and is not seen to stay, such as somebody who walks by, is taken back out of the map.

A camera sees where people were last before they left its view; as far as it knows they stand there for good. So every
place that something comes into is kept as it was, and given back when nothing was seen in it for a while. What stays in
view in one place is no visitor.

A camera that looks ahead sees no more than the upper half of who stands close to it. Who comes into free space stands
on the floor: what was seen of him goes on down to it, where the image does not show otherwise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation

from .bricks import SIDE, BrickVolume
from .departed import looked_past
from .lately import Lately
from .lattice import Lattice
from .seeds import ENDED
from .standing import columns, corners, extend_down, feet, parts, vertical
from .visited import visited_places

# Seen in one place for longer than this [s], something has come to stay; who walks may wait for a robot for a while.
STAYS = 15.0
# What is nearer than this to the camera [m] is not taken back unless it has visibly gone: close to its own robot a
# camera sees little.
NEAR = 1.2
# Coarse nodes, and bricks, a side of a place, the unit that is kept and given back.
NODES = BRICKS = 2
# Something came where distances are less than before by this much [m]; so many voxels a side are told apart.
NEARER, CUBE = 0.02, 4


class Kept(NamedTuple):
    """Places as they were before something came.

    Args:
        place: (n, 3) index of each: the bricks of a place and their coarse nodes are those of its box.
        first: (n,) when something was seen in it first [s], inf if it only came near.
        last: (n,) when something was seen in it last, or when it was kept [s].
        past: (n,) when it was seen last that nobody stands in it, see `isdf.mapping.departed` [s], -inf if never.
        distance: (n, bricks, 512) float32 [m].
        weight: (n, bricks, 512) float32, 0 where nothing was observed.
        ended: (n, bricks, 512) float32, see `isdf.mapping.bricks.Bricks`.
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
        lattice: the evidence of free space, its nodes as far apart as bricks are wide.
        before: a visitor changes places from this far before its surface [m], up to `isdf.mapping.evidence.INSIDE` [m]
            behind it.
        memory: how long something that is out of view stays in the map [s]; None: for ever.
    """

    def __init__(self, bricks: BrickVolume, lattice: Lattice, before: float, memory: float | None) -> None:
        self.bricks, self.lattice, self.before, self.memory = bricks, lattice, before, memory
        self.edge = NODES * lattice.spacing
        self._offsets = np.argwhere(np.ones((BRICKS,) * 3, dtype=bool))
        self._kept = self._copied(np.empty((0, 3), dtype=np.int64), 0.0)
        self._feet = np.empty((0, 5), dtype=np.int64)

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
        pixels = visited_places(
            self.edge, self._corner, self.before, self.lattice.arrays, self.lattice.corner, table,
            self._kept.evidence, depth, appeared, stride, intrinsics, T_world_camera,
        )  # fmt: skip
        visited = pixels != 0
        axis, way = vertical(up)
        ground = int(np.floor(floor / self.edge)) - int(self._corner[axis])
        self._feet = feet(pixels, inside, axis, way, ground)
        visited[tuple(columns(self._feet, axis, way).T)] = True
        # Whoever walks on comes into the neighbours next, little by little: keep those, too.
        near = binary_dilation(visited, np.ones((3, 3, 3), dtype=bool)) & (table < 0) & inside
        self._kept = self._kept.and_also(self._copied(np.argwhere(near) + self._corner, now))
        rows = self._table()[visited & inside]
        self._kept.first[rows] = np.minimum(self._kept.first[rows], now)
        self._kept.last[rows] = now
        seen = np.isfinite(self._kept.first)
        past = looked_past(self._kept.place, seen, self.edge, depth, intrinsics, T_world_camera, axis)
        # A column in which somebody is seen to stand is not empty, though a ray passes its middle: else his head would
        # be given back before his feet, and nothing would tell any more that he was tall.
        taken = np.broadcast_to(visited.any(axis=axis, keepdims=True), visited.shape)
        self._kept.past[past & ~taken[tuple((self._kept.place - self._corner).T)]] = now

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
        highest = parts(self._feet, BRICKS, axis, way)
        under = np.unique(columns(highest, axis, way), axis=0)
        self.bricks.add(under[self.bricks.table[tuple(under.T)] < 0])
        extend_down(self.bricks.arrays, highest, BRICKS, axis, way, depth, intrinsics, T_camera_world)
        return SIDE * self.bricks.voxel * (self.bricks.corner + corners(under))

    def take_back(self, eye: Float[np.ndarray, "3"], now: float) -> Float[np.ndarray, "2 3"] | None:
        """Give back the places whose visitors have visibly gone, or have been out of view for long enough.

        Args:
            eye: where the camera is [m].
            now: [s].

        Returns:
            The box [m] that is to be refreshed, None where nothing has changed.
        """
        kept = self._kept
        if self.memory is None or len(kept.place) == 0:
            return None
        stood = kept.last - kept.first
        near = np.linalg.norm(self.edge * (kept.place + 0.5) - eye, axis=1) < NEAR
        # Who stood for a while may stand for as long again.
        forgotten = ~near & (now - kept.last > np.maximum(self.memory, stood))
        gone = forgotten | (kept.past > kept.last)
        self._kept = kept.of(~gone & (stood <= STAYS))
        back = kept.of(gone & np.isfinite(kept.first))
        if len(back.place) == 0:
            return None
        self._give_back(back)
        return self.edge * corners(back.place)

    def lately(self) -> Lately:
        """Where something came and, as far as the camera knows, still is."""
        kept = self._kept.of(np.isfinite(self._kept.first))
        row = self._rows(kept.place)
        there = (row >= 0)[..., None] & (self.bricks.weight[row] > 0) & (self.bricks.ended[row] >= ENDED)
        there &= self._nearer(self.bricks.distance[row], kept.distance, kept.weight)
        # Some voxels a side are one cube.
        side = SIDE // CUBE
        cubes = there.reshape(*row.shape, *(side, CUBE) * 3).any(axis=(3, 5, 7))
        place, brick, *inside = np.nonzero(cubes)
        bricks = BRICKS * kept.place[place] + self._offsets[brick]
        return Lately.of(side * bricks + np.stack(inside, axis=1), CUBE * self.bricks.voxel)

    def _nearer(
        self,
        now: Float[np.ndarray, "*bricks 512"],
        before: Float[np.ndarray, "*bricks 512"],
        weight: Float[np.ndarray, "*bricks 512"],
    ) -> Bool[np.ndarray, "*bricks 512"]:
        """Where distances [m] are less than before; what had no `weight` was not known to be free."""
        return np.where(weight > 0, now < before - NEARER, now < self.before)

    @property
    def _corner(self) -> Int[np.ndarray, "3"]:
        """Index of the first place; the table of bricks begins with a whole one, for it grows by blocks of four."""
        return self.bricks.corner // BRICKS

    @property
    def _shape(self) -> tuple[int, ...]:
        """Places an axis."""
        return tuple(n // BRICKS for n in self.bricks.table.shape)

    def _rows(self, place: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "n bricks"]:
        """Numbers of the bricks of each place, -1 where none is stored."""
        index = BRICKS * place[:, None] + self._offsets - self.bricks.corner
        return self.bricks.table[tuple(np.moveaxis(index, -1, 0))]

    def _table(self) -> Int[np.ndarray, "nx ny nz"]:
        """Row of every place that is kept, -1 elsewhere; as large as the table of bricks, which never shrinks."""
        table = np.full(self._shape, -1, dtype=np.int32)
        table[tuple((self._kept.place - self._corner).T)] = np.arange(len(self._kept.place))
        return table

    def _in_lattice(self) -> Bool[np.ndarray, "nx ny nz"]:
        """Which places have their nodes in the lattice."""
        first = self.lattice.corner // NODES - self._corner
        inside = np.zeros(self._shape, dtype=bool)
        slices = zip(first, first + np.array(self.lattice.shape) // NODES, strict=True)
        inside[tuple(slice(max(0, a), max(0, b)) for a, b in slices)] = True
        return inside

    def _copied(self, place: Int[np.ndarray, "n 3"], now: float) -> Kept:
        """Places as they are."""
        count = len(place)
        row = self._rows(place) if count else np.empty((0, BRICKS**3), np.int32)
        distance, weight, ended = (np.zeros((*row.shape, SIDE**3), dtype=np.float32) for _ in range(3))
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
        """First node and evidence of a window that holds some places, and where in it their nodes are."""
        begin, end = NODES * place.min(axis=0), NODES * (place.max(axis=0) + 1)
        seen = self.lattice.read("evidence", begin - self.lattice.corner, end - self.lattice.corner)
        first, step = (NODES * place - begin)[:, :, None, None, None], np.indices((NODES,) * 3)
        return begin, seen, tuple(first[:, axis] + step[axis] for axis in range(3))

    def _give_back(self, back: Kept) -> None:
        """Undo what brought surfaces nearer and made space less free; what was learnt of free space stays."""
        row = self._rows(back.place)
        there = row >= 0
        row, before, weight = row[there], back.distance[there], back.weight[there]
        now = self.bricks.distance[row]
        nearer = self._nearer(now, before, weight)
        self.bricks.distance[row] = np.where(nearer, before, now)
        self.bricks.weight[row] = np.where(nearer, weight, self.bricks.weight[row])
        self.bricks.ended[row] = np.where(nearer, back.ended[there], self.bricks.ended[row])
        self.bricks.changed(row)
        begin, seen, nodes = self._evidence(back.place)
        seen[nodes] = np.maximum(seen[nodes], back.evidence)
        begin = begin - self.lattice.corner
        self.lattice.write(begin, begin + seen.shape, evidence=seen)
