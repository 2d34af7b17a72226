"""Handing the newest of something to another thread without ever waiting for it."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Mailbox(Generic[T]):
    """Holds one letter: a new one replaces the one that nobody has fetched."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._letter: T | None = None
        self.replaced = 0
        """How many letters nobody has fetched in time."""

    def put(self, letter: T) -> None:
        """Leave a letter; returns at once."""
        with self._changed:
            self.replaced += self._letter is not None
            self._letter = letter
            self._changed.notify()

    def take(self, timeout: float) -> T | None:
        """The newest letter, once; None where none came within `timeout` [s]."""
        with self._changed:
            self._changed.wait_for(lambda: self._letter is not None, timeout)
            letter, self._letter = self._letter, None
            return letter
