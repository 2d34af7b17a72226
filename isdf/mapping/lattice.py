"""The values that answer queries: a coarse lattice over the whole map, refined where straight lines do not do."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, UInt8

from ..errors import FrameError
from ..extent import fits
from .bricks import moved

# Fine nodes a side of a refined cell: a cell of four fine steps shares its faces with its neighbours.
FINE = 5
BLOCK = FINE**3
# Steps of the stored corrections of a refined cell [m].
STEP = 0.0012
# The lattice grows by whole blocks of this many coarse nodes a side.
GROWTH = 8
# Most coarse nodes, at twenty bytes each; at the default spacing they fill a hundred thousand cubic metres.
MAX_NODES = 32_000_000


class LatticeArrays(NamedTuple):
    """What compiled code sees of a lattice.

    Args:
        origin: (3,) world position of the first node [m].
        spacing: of coarse nodes [m].
        value: (nx, ny, nz) float32 [m].
        confidence: uint8, of the same shape as all that follow.
        block: int32.
        corrections: (n, 125) int8.
        evidence: uint8, see `isdf.mapping.evidence`; a single node where it is not needed.
    """

    origin: np.ndarray
    spacing: float
    value: np.ndarray
    confidence: np.ndarray
    block: np.ndarray
    corrections: np.ndarray
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
        self.value = np.zeros((0, 0, 0), dtype=np.float32)
        self.confidence = np.zeros((0, 0, 0), dtype=np.uint8)
        self.block = np.full((0, 0, 0), -1, dtype=np.int32)
        self.corrections: Int8[np.ndarray, "blocks 125"] = np.zeros((1024, BLOCK), dtype=np.int8)
        self.used = 0
        self.spare: list[int] = []
        self.evidence: UInt8[np.ndarray, "nx ny nz"] = np.zeros((0, 0, 0), dtype=np.uint8)
        self.share = np.zeros((0, 0, 0), dtype=np.float16)
        self.width = np.zeros((0, 0, 0), dtype=np.float16)

    @property
    def shape(self) -> tuple[int, ...]:
        """Coarse nodes an axis."""
        return self.value.shape

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [bytes]."""
        nodes = (self.value, self.confidence, self.block, self.evidence, self.share, self.width)
        return sum(a.nbytes for a in nodes) + self.corrections[: self.used].nbytes

    def include(self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]) -> None:
        """Grow to cover a world box [m]; new nodes are unknown.

        Raises:
            FrameError: that would take more than `MAX_NODES`; nothing has changed.
        """
        edge = self.spacing * GROWTH
        low = np.floor(np.asarray(lower) / edge) * GROWTH
        high = np.ceil(np.asarray(upper) / edge) * GROWTH
        if self.value.size:
            low = np.minimum(low, self.corner)
            high = np.maximum(high, self.corner + self.shape)
        size = high - low
        if np.array_equal(size, self.shape):
            return
        if not fits(low, high, MAX_NODES):
            raise FrameError(
                f"this frame would make the map {' x '.join(f'{s * self.spacing:.0f}' for s in size)} m, more than "
                f"{MAX_NODES} nodes {self.spacing:.3g} m apart; if its pose is right, choose a larger voxel"
            )
        first, size = low.astype(np.int64), size.astype(np.int64)
        for name, empty in (
            ("value", 1.0), ("confidence", 0), ("block", -1), ("evidence", 0), ("share", 0.5), ("width", -0.7)
        ):  # fmt: skip
            setattr(self, name, moved(getattr(self, name), self.corner, first, size, empty))
        self.corner = first

    def window(
        self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]
    ) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
        """First and one past the last array index of the nodes in a world box [m], clipped to the lattice."""
        begin = np.floor(np.asarray(lower) / self.spacing).astype(np.int64) - self.corner
        end = np.ceil(np.asarray(upper) / self.spacing).astype(np.int64) + 1 - self.corner
        shape = np.array(self.shape)
        return np.clip(begin, 0, shape), np.clip(end, 0, shape)

    def reassign(
        self,
        block: Int[np.ndarray, "mx my mz"],
        wanted: Bool[np.ndarray, "mx my mz"],
        unwanted: Bool[np.ndarray, "mx my mz"],
    ) -> Bool[np.ndarray, "mx my mz"]:
        """Give blocks of corrections to wanted cells that have none and take those of unwanted ones.

        Args:
            block: numbers of the cells of a window, changed.
            wanted: cells to be refined.
            unwanted: cells that need no refinement.

        Returns:
            The cells that got a block; what it holds is of another cell.
        """
        dropped = unwanted & (block >= 0)
        self.spare += block[dropped].tolist()
        block[dropped] = -1
        fresh = wanted & (block < 0)
        count = int(fresh.sum())
        reused = [self.spare.pop() for _ in range(min(count, len(self.spare)))]
        added = count - len(reused)
        while self.used + added > len(self.corrections):
            more = np.zeros((max(1024, len(self.corrections)), BLOCK), dtype=np.int8)
            self.corrections = np.concatenate([self.corrections, more])
        block[fresh] = [*reused, *range(self.used, self.used + added)]
        self.used += added
        return fresh

    @property
    def arrays(self) -> LatticeArrays:
        """For compiled code."""
        return LatticeArrays(
            self.corner * self.spacing,
            self.spacing,
            self.value,
            self.confidence,
            self.block,
            self.corrections,
            self.evidence,
        )
