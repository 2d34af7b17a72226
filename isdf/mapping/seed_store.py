"""Seeds of every brick, kept from one time to the next."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

# Seeds that there is room for at first.
ROOM = 4096


class SeedStore:
    """The seeds of each brick lie in a row; found anew they go to the end, and the gaps are closed when room runs out.

    Attributes:
        state: (bricks,) int64 what the seeds of each brick were found in, -1 where nothing was looked for.
        first: (bricks,) int64 where its seeds begin.
        number: (bricks,) int64 of its seeds.
        seeds: (room, 8) float32, see `isdf.mapping.seeds.surface_seeds`.
    """

    def __init__(self) -> None:
        self.state, self.first, self.number = (np.empty(0, dtype=np.int64) for _ in range(3))
        self.seeds = np.empty((ROOM, 8), dtype=np.float32)
        self._end = 0

    def fit(self, bricks: int) -> None:
        """Make room for so many bricks."""
        more = max(bricks, 2 * len(self.state)) - len(self.state) if bricks > len(self.state) else 0
        if more:
            self.state = np.concatenate([self.state, np.full(more, -1, dtype=np.int64)])
            self.first, self.number = (
                np.concatenate([array, np.zeros(more, dtype=np.int64)]) for array in (self.first, self.number)
            )

    def put(
        self,
        bricks: Int[np.ndarray, "m"],
        state: Int[np.ndarray, "m"],
        number: Int[np.ndarray, "m"],
        seeds: Float[np.ndarray, "n 8"],
    ) -> None:
        """Replace the seeds of some bricks."""
        self.number[bricks] = 0
        if self._end + len(seeds) > len(self.seeds):
            self._close_gaps(len(seeds))
        self.state[bricks], self.number[bricks] = state, number
        self.first[bricks] = self._end + np.cumsum(number) - number
        self.seeds[self._end : self._end + len(seeds)] = seeds
        self._end += len(seeds)

    def _close_gaps(self, more: int) -> None:
        """Write the seeds one after the other, with room for more, and for as many again, at the end."""
        first, used = np.cumsum(self.number) - self.number, int(self.number.sum())
        where = np.repeat(self.first - first, self.number) + np.arange(used)
        seeds = np.empty((max(ROOM, 2 * (used + more)), 8), dtype=np.float32)
        seeds[:used] = self.seeds[where]
        self.first, self.seeds, self._end = first, seeds, used
