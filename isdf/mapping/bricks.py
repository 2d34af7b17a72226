"""A truncated signed distance volume that is stored only near surfaces, in bricks of 8 x 8 x 8 voxels."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from ..errors import FrameError
from ..extent import fits
from .seed_store import SeedStore

SIDE = 8
VOXELS = SIDE**3
# The table of bricks grows by whole blocks of this many bricks a side.
GROWTH = 4


class Bricks(NamedTuple):
    """What compiled code sees of a brick volume.

    Args:
        table: (nx, ny, nz) int32 number of every brick, -1 where none is stored.
        corner: (3,) lattice index of the table's first brick.
        distance: (bricks, 512) float32 [m].
        weight: (bricks, 512) float32.
        ended: (bricks, 512) float32, share of the views, by weight, that ended within a voxel of it.
        voxel: edge of a voxel [m].
        changes: (bricks,) int64, how often each has changed; whoever changes one counts it here.
    """

    table: np.ndarray
    corner: np.ndarray
    distance: np.ndarray
    weight: np.ndarray
    ended: np.ndarray
    voxel: float
    changes: np.ndarray


class BrickVolume:
    """Weighted mean distances and weights of voxels whose lattice is fixed to the world's origin.

    Voxel n of the lattice has its centre at voxel * n [m]; brick b holds voxels 8 b .. 8 b + 7 of every axis.

    Args:
        voxel: edge of a voxel [m].
        max_bricks: a frame that needs a larger table is refused.
    """

    def __init__(self, voxel: float, max_bricks: int) -> None:
        self.voxel, self.max_bricks = float(voxel), int(max_bricks)
        self.corner = np.zeros(3, dtype=np.int64)
        self.table = np.full((0, 0, 0), -1, dtype=np.int32)
        self.count = 0
        self._distance = np.zeros((256, VOXELS), dtype=np.float32)
        self._weight = np.zeros((256, VOXELS), dtype=np.float32)
        self._ended = np.zeros((256, VOXELS), dtype=np.float32)
        self._changes = np.zeros(256, dtype=np.int64)
        self.seeds = SeedStore()

    @property
    def distance(self) -> Float[np.ndarray, "bricks 512"]:
        """Weighted mean of the truncated distances along the viewing axis [m], positive in front of surfaces."""
        return self._distance[: self.count]

    @property
    def weight(self) -> Float[np.ndarray, "bricks 512"]:
        """Sum of the weights of all measurements, up to a limit; 0 where a voxel was never observed."""
        return self._weight[: self.count]

    @property
    def ended(self) -> Float[np.ndarray, "bricks 512"]:
        """Share of the views of every voxel, by weight, that ended there: evidence of a surface in [0, 1]."""
        return self._ended[: self.count]

    @property
    def arrays(self) -> Bricks:
        """For compiled code, which may change the distances and weights in place, and counts that in `changes`."""
        return Bricks(
            self.table, self.corner, self._distance, self._weight, self._ended, self.voxel, self._changes
        )

    def changed(self, rows: Int[np.ndarray, "n"]) -> None:
        """Call after writing to `distance`, `weight` or `ended` of these bricks: surfaces are found anew in them."""
        self._changes[rows] += 1

    def box(
        self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]
    ) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
        """First and one past the last array index of the bricks in a world box [m], clipped to the table."""
        edge, shape = SIDE * self.voxel, np.array(self.table.shape)
        begin = np.floor(np.asarray(lower) / edge).astype(np.int64) - self.corner
        end = np.floor(np.asarray(upper) / edge).astype(np.int64) + 1 - self.corner
        return np.clip(begin, 0, shape), np.clip(end, 0, shape)

    @property
    def nbytes(self) -> int:
        """Memory in use [bytes], without the seeds, which can be found again."""
        return self.table.nbytes + self.distance.nbytes + self.weight.nbytes + self.ended.nbytes

    def include(self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]) -> None:
        """Grow the table of bricks to cover a world box [m].

        Raises:
            FrameError: that would take more than `max_bricks` entries; nothing has changed.
        """
        edge = SIDE * self.voxel * GROWTH
        low = np.floor(np.asarray(lower) / edge - 0.5) * GROWTH
        high = np.ceil(np.asarray(upper) / edge + 0.5) * GROWTH
        if self.table.size:
            low = np.minimum(low, self.corner)
            high = np.maximum(high, self.corner + self.table.shape)
        size = high - low
        if np.array_equal(size, self.table.shape):
            return
        if not fits(low, high, self.max_bricks):
            sides = " x ".join(f"{s * SIDE * self.voxel:.0f}" for s in size)
            raise FrameError(
                f"this frame would make the map {sides} m, more than max_bricks = {self.max_bricks}; if its pose is "
                "right, raise that or choose a smaller max_depth"
            )
        first, size = low.astype(np.int64), size.astype(np.int64)
        self.table = moved(self.table, self.corner, first, size, -1)
        self.corner = first

    def add(self, places: Int[np.ndarray, "n 3"]) -> None:
        """Make room for the bricks at these array indices of the table, which must not exist yet."""
        needed, size = self.count + len(places), len(self._distance)
        if needed > size:
            size = max(2 * size, needed)
            for name in ("_distance", "_weight", "_ended", "_changes"):
                setattr(self, name, self._longer(getattr(self, name), size))
        self.table[tuple(places.T)] = np.arange(self.count, self.count + len(places))
        self.count += len(places)

    def _longer(self, values: np.ndarray, size: int) -> np.ndarray:
        # Of zeros that are asked for, none takes memory or time before it is written: joined to the end they would.
        out = np.zeros((size, *values.shape[1:]), dtype=values.dtype)
        out[: self.count] = values[: self.count]
        return out

    def restore(
        self,
        table: Int[np.ndarray, "nx ny nz"],
        distance: Float[np.ndarray, "n 512"],
        weight: Float[np.ndarray, "n 512"],
        ended: Float[np.ndarray, "n 512"],
    ) -> None:
        """Take over the bricks of another volume.

        Raises:
            FrameError: the arrays do not fit each other.
        """
        shapes = {distance.shape, weight.shape, ended.shape}
        if table.ndim != 3 or len(shapes) > 1 or distance.shape[1:] != (VOXELS,):
            raise FrameError(f"bricks of shapes {table.shape} and {sorted(shapes)} do not fit")
        if table.max(initial=-1) >= len(distance) or table.min(initial=-1) < -1:
            raise FrameError(f"a table of bricks up to {table.max()} does not fit {len(distance)} bricks")
        self.table, self.count = table.astype(np.int32), len(distance)
        self._distance, self._weight = distance.astype(np.float32), weight.astype(np.float32)
        self._ended = ended.astype(np.float32)
        self._changes, self.seeds = np.zeros(self.count, dtype=np.int64), SeedStore()


def moved(
    old: np.ndarray, corner: np.ndarray, first: np.ndarray, size: np.ndarray, empty: float | int
) -> np.ndarray:
    """A lattice array in a larger box: entry 0 was at lattice index `corner` and is at `first` now."""
    new = np.full(tuple(size), empty, dtype=old.dtype)
    if old.size:
        offset = corner - first
        new[tuple(slice(o, o + n) for o, n in zip(offset, old.shape, strict=True))] = old
    return new


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def row_of(bricks: Bricks, i: int, j: int, k: int) -> tuple[int, int]:
    """Brick, -1 where none is stored, and place in it of the voxel at a lattice index."""
    table, corner = bricks.table, bricks.corner
    a, b, c = (i >> 3) - corner[0], (j >> 3) - corner[1], (k >> 3) - corner[2]
    if a < 0 or b < 0 or c < 0 or a >= table.shape[0] or b >= table.shape[1] or c >= table.shape[2]:
        return np.int32(-1), 0
    return table[a, b, c], (i & 7) * 64 + (j & 7) * 8 + (k & 7)


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def voxel_at(bricks: Bricks, i: int, j: int, k: int) -> tuple[np.float32, np.float32]:
    """Distance [m] and weight of the voxel at a lattice index; 0 and 0 where nothing is stored."""
    brick, at = row_of(bricks, i, j, k)
    if brick < 0:
        return np.float32(0), np.float32(0)
    return bricks.distance[brick, at], bricks.weight[brick, at]


# A view reaches this much farther [m] than the surfaces that are fused.
BEYOND_BAND = 0.1


@njit(cache=True, nogil=True)
@no_type_check
def view_box(depth, noise, least, intrinsics, T_world_camera):
    """Corners (2, 3) [m] of the box that holds a camera and all it sees, to the end of the truncation and a bit more.

    Every pixel counts, for each may need a brick in the table. Arguments as for `missing_bricks`.
    """
    fx, fy, cx, cy = intrinsics
    box = np.empty((2, 3))
    box[0] = box[1] = T_world_camera[:3, 3]
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float64(depth[v, u])
            if z <= 0:
                continue
            z += max(least, noise * z * z) + BEYOND_BAND
            a, b = (u - cx) / fx * z, (v - cy) / fy * z
            for axis in range(3):
                at = (
                    T_world_camera[axis, 0] * a + T_world_camera[axis, 1] * b + T_world_camera[axis, 2] * z
                    + T_world_camera[axis, 3]
                )  # fmt: skip
                box[0, axis] = min(box[0, axis], at)
                box[1, axis] = max(box[1, axis], at)
    return box


@njit(cache=True, nogil=True)
@no_type_check
def missing_bricks(bricks: Bricks, depth, stride, noise, least, intrinsics, T_world_camera):
    """Array indices (n, 3) of the bricks that surfaces of a depth image need and the table lacks.

    Args:
        bricks: its table is changed: -2 marks what was found.
        depth: (h, w) z-depth [m], 0 = unknown.
        stride: every so many pixels is looked at.
        noise: truncation per squared depth.
        least: least truncation [m].
        intrinsics: fx, fy, cx, cy.
        T_world_camera: (4, 4).
    """
    fx, fy, cx, cy = intrinsics
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    table, corner, edge = bricks.table, bricks.corner, 8 * bricks.voxel
    found = []
    for v in range(0, depth.shape[0], stride):
        for u in range(0, depth.shape[1], stride):
            z = depth[v, u]
            if z <= 0:
                continue
            band = max(least, noise * z * z)
            a, b = (u - cx) / fx, (v - cy) / fy
            near = max(0.0, z - band)  # what lies behind the camera is never fused
            steps = int(np.ceil((z + band - near) / (0.4 * edge)))
            for n in range(steps + 1):
                w = near + (z + band - near) * n / steps
                i = int(np.floor((R[0, 0] * a + R[0, 1] * b + R[0, 2]) * w / edge + t[0] / edge)) - corner[0]
                j = int(np.floor((R[1, 0] * a + R[1, 1] * b + R[1, 2]) * w / edge + t[1] / edge)) - corner[1]
                k = int(np.floor((R[2, 0] * a + R[2, 1] * b + R[2, 2]) * w / edge + t[2] / edge)) - corner[2]
                if table[i, j, k] == -1:
                    table[i, j, k] = -2
                    found.append((i, j, k))
    out = np.empty((len(found), 3), dtype=np.int64)
    for n in range(len(found)):
        out[n, 0], out[n, 1], out[n, 2] = found[n]
    return out
