"""The values that answer queries: a coarse lattice wherever the map is, refined where straight lines do not do.

Its nodes are kept in chunks, its refined cells in blocks; both share memory with the snapshots that planners ask.
"""

from __future__ import annotations

from typing import Any, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, Int16
from numba import njit

from ..errors import FrameError
from ..extent import fits
from .bricks import moved
from .pool import Pool, Readers

# Fine nodes a side of a refined cell: a cell of four fine steps shares its faces with its neighbours.
FINE = 5
BLOCK = FINE**3
# Steps of the stored corrections of a refined cell, and of the stored distances at coarse nodes [m].
STEP, UNIT = 0.0012, 0.00025
# Distance [m] where nothing is known.
FAR = 1.0
# Coarse nodes a side of a chunk; compiled code shifts and masks by it.
CHUNK = 8
# Most chunks that the box about the map may have room for, at four bytes each where nothing is.
MAX_CHUNKS = 4_000_000
# What is kept of a node: its type, and what holds where nothing was written; distances in units, see `in_units`.
# Snapshots read those published.
NODES: dict[str, tuple[Any, float]] = {
    "value": (np.int16, FAR / UNIT),
    "confidence": (np.uint8, 0.0),
    "block": (np.int32, -1.0),
    "evidence": (np.uint8, 0.0),
    "share": (np.float16, 0.5),
    "width": (np.float16, -0.7),
}
PUBLISHED = ("value", "confidence", "block", "evidence")


class LatticeArrays(NamedTuple):
    """What compiled code sees of a lattice.

    Args:
        origin: (3,) world position of the first node [m].
        spacing: of coarse nodes [m].
        table: (cx, cy, cz) int32 row of every chunk, -1 where there is none.
        value: (rows, 512) int16 distances in `UNIT`s, see `distance_at`.
        confidence: (rows, 512) uint8.
        evidence: (rows, 512) uint8, see `isdf.mapping.evidence`.
    """

    origin: np.ndarray
    spacing: float
    table: np.ndarray
    value: np.ndarray
    confidence: np.ndarray
    evidence: np.ndarray


class Lattice:
    """Distances and expected errors at coarse nodes, corrections in refined cells.

    Node n of the coarse lattice lies at spacing * n [m]. A cell is refined when `block` of its lowest node is not -1:
    then 5 x 5 x 5 fine nodes hold what trilinear interpolation of the corners misses, in steps.

    Args:
        spacing: of coarse nodes [m].
    """

    def __init__(self, spacing: float) -> None:
        self.spacing = float(spacing)
        self.corner = np.zeros(3, dtype=np.int64)
        self.table = np.full((0, 0, 0), -1, dtype=np.int32)
        self.readers = Readers()
        self.nodes = Pool(NODES, CHUNK**3, self.readers)
        self.cells = Pool({"corrections": (np.int8, 0.0)}, BLOCK, self.readers)

    @property
    def shape(self) -> tuple[int, ...]:
        """Coarse nodes an axis of the box about the map."""
        return tuple(CHUNK * n for n in self.table.shape)

    @property
    def corrections(self) -> np.ndarray:
        """(rows, 125) int8 of all refined cells."""
        return self.cells.arrays["corrections"]

    @property
    def nbytes(self) -> int:
        """Memory in use [bytes]."""
        return self.table.nbytes + self.nodes.nbytes + self.cells.nbytes

    def include(self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]) -> None:
        """Grow the box to cover a world box [m]; nothing is known of its new parts.

        Raises:
            FrameError: that would take more than `MAX_CHUNKS`; nothing has changed.
        """
        edge = self.spacing * CHUNK
        first, last = np.floor(np.asarray(lower) / edge), np.ceil(np.asarray(upper) / edge)
        if self.table.size:
            first = np.minimum(first, self.corner // CHUNK)
            last = np.maximum(last, self.corner // CHUNK + self.table.shape)
        size = last - first
        if np.array_equal(size, self.table.shape):
            return
        if not fits(first, last, MAX_CHUNKS):
            raise FrameError(
                f"this frame would make the map {' x '.join(f'{s * edge:.0f}' for s in size)} m, more than "
                f"{MAX_CHUNKS} chunks of {edge:.3g} m a side; if its pose is right, choose a larger voxel"
            )
        first, size = first.astype(np.int64), size.astype(np.int64)
        self.table = moved(self.table, self.corner // CHUNK, first, size, -1)
        self.corner = first * CHUNK

    def window(
        self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]
    ) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
        """First and one past the last array index of the nodes in a world box [m], clipped to the lattice."""
        begin = np.floor(np.asarray(lower) / self.spacing).astype(np.int64) - self.corner
        end = np.ceil(np.asarray(upper) / self.spacing).astype(np.int64) + 1 - self.corner
        shape = np.array(self.shape)
        return np.clip(begin, 0, shape), np.clip(end, 0, shape)

    def read(self, name: str, begin: Int[np.ndarray, "3"], end: Int[np.ndarray, "3"]) -> np.ndarray:
        """Copy of one kind of values of the nodes of a window, empty ones where nothing was written."""
        kind, empty = NODES[name]
        out = np.full(tuple(end - begin), empty, dtype=kind)
        _copy(self.table, _bits(self.nodes.arrays[name]), begin, _bits(out), False)
        return out

    def write(self, begin: Int[np.ndarray, "3"], end: Int[np.ndarray, "3"], **values: np.ndarray) -> None:
        """Set some kinds of values of the nodes of a window; no snapshot changes.

        Raises:
            TypeError: values are of a kind that does not fit, such as distances in metres instead of units.
        """
        kept = {
            name: np.asarray(window).astype(NODES[name][0], order="C", casting="same_kind", copy=False)
            for name, window in values.items()
        }
        part = tuple(slice(b // CHUNK, -(-e // CHUNK)) for b, e in zip(begin, end, strict=True))
        table, nodes = self.table[part], self.nodes
        missing = table < 0
        fresh = nodes.take(int(missing.sum()))
        for name, (_, empty) in NODES.items():
            nodes.arrays[name][fresh] = empty
        table[missing] = fresh
        if any(name in PUBLISHED for name in values):
            shared = nodes.shared(table)
            rows = table[shared]
            copies = nodes.take(len(rows))
            for array in nodes.arrays.values():
                array[copies] = array[rows]
            table[shared] = copies
            nodes.release(rows)
        for name, window in kept.items():
            _copy(self.table, _bits(nodes.arrays[name]), begin, _bits(window), True)

    def reassign(
        self,
        block: Int[np.ndarray, "mx my mz"],
        wanted: Bool[np.ndarray, "mx my mz"],
        unwanted: Bool[np.ndarray, "mx my mz"],
    ) -> None:
        """Give fresh blocks of corrections, to be written, to wanted cells, and take those that unwanted ones have.

        Args:
            block: rows of the cells of a window, changed.
            wanted: cells whose corrections are written anew.
            unwanted: cells that need none.
        """
        dropped = (wanted | unwanted) & (block >= 0)
        self.cells.release(block[dropped].astype(np.int64))
        block[dropped] = -1
        block[wanted] = self.cells.take(int(wanted.sum()))

    @property
    def arrays(self) -> LatticeArrays:
        """For compiled code."""
        nodes = self.nodes.arrays
        return LatticeArrays(
            self.corner * self.spacing,
            self.spacing,
            self.table,
            nodes["value"],
            nodes["confidence"],
            nodes["evidence"],
        )


def in_units(values: Float[np.ndarray, "nx ny nz"]) -> Int16[np.ndarray, "nx ny nz"]:
    """Distances [m] as they are stored; beyond 8 m they are cut off."""
    most = np.iinfo(np.int16).max
    return np.clip(np.rint(values / UNIT), -most, most).astype(np.int16)


def _bits(values: np.ndarray) -> np.ndarray:
    """The same memory, as a type that compiled code knows: half precision it does not."""
    return values.view(np.uint16) if values.dtype == np.float16 else values


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def node_at(table, values, i, j, k, empty):
    """Value of the node at an array index of the lattice, `empty` where there is no chunk."""
    row = table[i >> 3, j >> 3, k >> 3]
    if row < 0:
        return empty
    return values[row, ((i & 7) << 6) | ((j & 7) << 3) | (k & 7)]


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def distance_at(table, value, i, j, k):
    """Distance [m] at the node at an array index of the lattice, `FAR` where there is no chunk."""
    return np.float32(UNIT) * np.float32(node_at(table, value, i, j, k, np.int16(round(FAR / UNIT))))


@njit(cache=True, nogil=True)
@no_type_check
def _copy(table, values, begin, window, into):
    """Copy the window that begins at a node from the chunks, or into them; where there is no chunk nothing happens."""
    for i in range(window.shape[0]):
        for j in range(window.shape[1]):
            for k in range(window.shape[2]):
                a, b, c = begin[0] + i, begin[1] + j, begin[2] + k
                row = table[a >> 3, b >> 3, c >> 3]
                if row < 0:
                    continue
                at = ((a & 7) << 6) | ((b & 7) << 3) | (c & 7)
                if into:
                    values[row, at] = window[i, j, k]
                else:
                    window[i, j, k] = values[row, at]
