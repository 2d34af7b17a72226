"""Saving a map every few seconds while it is made, stopping when asked to, and taking a stopped run up again."""

from __future__ import annotations

import dataclasses
import signal
import time
import typing
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from . import mapfile
from .errors import CheckpointError, NotReadyError
from .methods import OnlineMapper, load_map
from .runner import Begun, RunReport, Watch

SIGNALS = (signal.SIGINT, signal.SIGTERM)
# A frame and a saving may take so many times the slowest of late, which count less with every further one.
CAUTION, FADING = 1.5, 0.95


class Stopped(Exception):
    """A run was asked to stop, and did so after the frame it was on; the checkpoint is written.

    Args:
        number: the signal that asked for it.
        saved: whether there was anything to save yet.
    """

    def __init__(self, number: int, saved: bool) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number, self.saved = number, saved


class Checkpointer:
    """A watcher of a run that saves its map, with what it takes to resume the run, atomically.

    It saves at the first frame, then so that a process killed at any moment has lost at most `every` seconds: early
    enough for one more frame and for saving, should both take somewhat longer than the slowest of late. Only a frame
    that takes much longer than those before it can cost more.

    As a context manager it takes over SIGINT and SIGTERM: the first one stops the run after the frame it is on, with
    a checkpoint and `Stopped`; the second interrupts at once and the last checkpoint stays.

    Args:
        path: the map file.
        every: seconds of wall time.
        report: of the run, as the runner keeps it up to date.
        options: what the run was started with; any JSON.
        watch: another watcher, called first.
    """

    def __init__(
        self, path: Path, every: float, report: RunReport, options: dict[str, Any], watch: Watch
    ) -> None:
        self.path, self.every, self.report, self.options = path, every, report, options
        self._watch = watch
        self._saved_at, self._called_at = -float("inf"), time.monotonic()
        self._gap = self._cost = 0.0  # slowest frame and slowest saving of late [s]
        self._signal: int | None = None
        self._former: dict[int, Any] = {}

    def __call__(self, mapper: OnlineMapper, arrived: int) -> None:
        """Save if it is due.

        Raises:
            Stopped: a signal came.
        """
        # What the other watcher takes, or waits for, is no time of the run's.
        self._gap = max(time.monotonic() - self._called_at, FADING * self._gap)
        self._watch(mapper, arrived)
        self._called_at = now = time.monotonic()
        if self._signal is not None:
            raise Stopped(self._signal, self.save(mapper, finished=False))
        if mapper.frames_seen and now - self._saved_at + CAUTION * (self._gap + self._cost) >= self.every:
            self.save(mapper, finished=False)

    @property
    def stopping(self) -> bool:
        """Whether a signal has asked the run to stop."""
        return self._signal is not None

    def save(self, mapper: OnlineMapper, finished: bool) -> bool:
        """Save now; False where nothing was seen yet.

        Args:
            mapper: of the run.
            finished: there is nothing to resume.
        """
        started = time.monotonic()
        run = {"options": self.options, "report": dataclasses.asdict(self.report), "finished": finished}
        try:
            mapper.save(self.path, {"run": run})
        except NotReadyError:
            return False
        # The file holds the map of this moment, not of when it was complete.
        self._saved_at, self._called_at = started, time.monotonic()
        self._cost = max(self._called_at - started, FADING * self._cost)
        return True

    def __enter__(self) -> Checkpointer:
        for number in SIGNALS:
            self._former[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, former in self._former.items():
            signal.signal(number, former)

    def _note(self, number: int, _: FrameType | None) -> None:
        if self._signal is not None:
            raise KeyboardInterrupt
        self._signal = number


def take_up(path: Path) -> tuple[Begun, dict[str, Any]]:
    """A run from its checkpoint: its mapper and report, and the options it was started with.

    Raises:
        CheckpointError: the file is no readable map, has no run in it, or that run is finished.
    """
    run = mapfile.header(path).get("run")
    if not isinstance(run, dict) or not isinstance(run.get("options"), dict):
        raise CheckpointError(f"{path}: holds a map but no run to resume; `isdf map` writes one that does")
    if run.get("finished"):
        raise CheckpointError(f"{path}: this run is finished, there is nothing to resume")
    with mapfile.consistent(path):
        report = _report(run["report"])
    return Begun(report, load_map(path)), run["options"]


def _report(values: dict[str, Any]) -> RunReport:
    known = typing.get_type_hints(RunReport)
    refused = {int(number): str(reason) for number, reason in values["frames_refused"].items()}
    numbers: dict[str, Callable[[Any], Any]] = {n: t for n, t in known.items() if t in (int, float)}
    counted = {name: kind(values[name]) for name, kind in numbers.items()}
    if not all(0 <= value < float("inf") for value in counted.values()):
        raise CheckpointError("the counts of its run are not finite and positive")
    return RunReport(frames_refused=refused, **counted)
