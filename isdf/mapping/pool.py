"""Rows of arrays that immutable snapshots share with the map that goes on: a row that is being read is never written.

Taking a snapshot copies nothing. What is written afterwards goes to fresh rows, and the old ones are used again once
every snapshot that may read them is gone.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

# Rows of a new pool; it doubles when they are used up.
FIRST = 256
NEVER = 1 << 62


class Readers:
    """Snapshots in the order in which they were taken, as long as anybody holds them."""

    def __init__(self) -> None:
        self.count = 0
        self._living: dict[int, weakref.ref[Any]] = {}

    def add(self, reader: Any) -> None:
        """A snapshot of everything as it is."""
        self.count += 1
        self._living[self.count] = weakref.ref(reader)

    def living(self) -> tuple[int, int]:
        """Numbers of the oldest and the newest snapshot that somebody holds; (NEVER, 0) if there is none."""
        self._living = {number: ref for number, ref in self._living.items() if ref() is not None}
        return min(self._living, default=NEVER), max(self._living, default=0)


class Pool:
    """Arrays of one number of rows, of which each is in use, spare, or only read by snapshots.

    Args:
        kinds: name -> type and what a fresh row holds.
        size: entries a row.
        readers: of the snapshots that may read the rows.
    """

    def __init__(self, kinds: Mapping[str, tuple[Any, float]], size: int, readers: Readers) -> None:
        self.kinds, self.size, self._readers = dict(kinds), size, readers
        self.arrays = {name: np.empty((0, size), dtype=kind) for name, (kind, _) in kinds.items()}
        self._born = np.zeros(0, dtype=np.int64)
        self._grow(FIRST)
        self._spare: list[int] = []
        self._retired: list[tuple[int, int]] = []
        self._end = 0

    @property
    def used(self) -> int:
        """Rows in use."""
        return self._end - len(self._spare) - len(self._retired)

    @property
    def nbytes(self) -> int:
        """Memory of the rows in use [bytes]."""
        return self.used * self.size * sum(a.itemsize for a in self.arrays.values())

    def take(self, count: int) -> Int[np.ndarray, "n"]:
        """Numbers of rows that nobody uses; what they hold is of no meaning."""
        oldest, _ = self._readers.living()
        free = [row for row, retired in self._retired if retired < oldest]
        if free:
            self._spare += free
            self._retired = [entry for entry in self._retired if entry[1] >= oldest]
        reused = [self._spare.pop() for _ in range(min(count, len(self._spare)))]
        fresh = range(self._end, self._end + count - len(reused))
        self._end = fresh.stop
        if self._end > len(self._born):
            self._grow(max(2 * len(self._born), self._end))
        rows = np.array([*reused, *fresh], dtype=np.int64)
        self._born[rows] = self._readers.count
        return rows

    def release(self, rows: Int[np.ndarray, "n"]) -> None:
        """These are not in use any more."""
        shared = self.shared(rows)
        self._retired += [(row, self._readers.count) for row in rows[shared].tolist()]
        self._spare += rows[~shared].tolist()

    def shared(self, rows: Int[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
        """Which of these rows a snapshot may be reading."""
        return self._born[rows] < self._readers.living()[1]

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over rows that are all in use, of the types and size of this pool."""
        self.arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        self._end = len(next(iter(self.arrays.values())))
        self._born = np.zeros(self._end, dtype=np.int64)
        self._retired, self._spare = [], []

    def _grow(self, rows: int) -> None:
        # New arrays: snapshots go on reading the old ones.
        added = rows - len(self._born)
        for name, (kind, empty) in self.kinds.items():
            self.arrays[name] = np.concatenate(
                [self.arrays[name], np.full((added, self.size), empty, dtype=kind)]
            )
        self._born = np.concatenate([self._born, np.zeros(added, dtype=np.int64)])
