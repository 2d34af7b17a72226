"""Mapping in a background thread, while planners in other threads ask snapshots of the field."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from jaxtyping import Float
from torch import Tensor

from .errors import BackgroundError, ConfigError, FrameError, NotReadyError
from .frames import DepthFrame
from .methods import OnlineMapper

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Snapshot:
    """A field as it was at one moment, and what it was made of; nothing in it changes.

    Args:
        field: the distance field.
        bounds: (2, 3) lower and upper corner of what was seen [m].
        number: snapshots before this one.
        frames: frames integrated.
        steps: optimisation steps made.
        frame_time: time stamp of the newest frame in it [s].
        made_at: `time.monotonic()` when it was made [s].
    """

    field: Any
    bounds: Float[Tensor, "2 3"]
    number: int
    frames: int
    steps: int
    frame_time: float
    made_at: float


@dataclass(frozen=True)
class Rates:
    """What happened since the start.

    Args:
        seconds: since the start [s].
        received: frames given to `integrate`.
        used: frames that are in the map.
        dropped: frames that newer ones pushed out of the queue.
        refused: frames that the mapper could not use; the log says why.
        steps: optimisation steps.
        snapshots: snapshots made.
        snapshot_interval: mean time between snapshots [s], NaN before the second.
    """

    seconds: float
    received: int
    used: int
    dropped: int
    refused: int
    steps: int
    snapshots: int
    snapshot_interval: float


class BackgroundMapper:
    """Runs a mapper in a thread of its own; use it as a context manager.

    `integrate` hands a frame over and returns at once. At most `queue_size` frames wait; one more drops the oldest of
    them, for a robot wants to know what is there now. While none waits, a mapper that can train does. `field` and
    `snapshot` give what was last published, without waiting for the mapper: from any number of threads, as often as
    wanted. A snapshot is made by the mapping thread between two steps, so none is torn, and is never changed.

    Compiled kernels, torch and numpy let other threads run while they compute, so mapping and planning share the cores
    and not the interpreter, but for their own Python code.

    Args:
        mapper: of any method; from now on only this object may touch it.
        queue_size: frames that may wait.
        publish_every: least time between two snapshots [s]; making one costs the mapper a copy of its network.

    Raises:
        ConfigError: the queue holds no frame, or the period is negative.
    """

    def __init__(self, mapper: OnlineMapper, queue_size: int = 2, publish_every: float = 0.05) -> None:
        if queue_size < 1 or not publish_every >= 0:
            raise ConfigError(
                f"queue_size must be at least 1 and publish_every zero or more seconds, got {queue_size} and "
                f"{publish_every}"
            )
        self._mapper, self._publish_every, self._queue_size = mapper, publish_every, queue_size
        self._changed = threading.Condition()
        # All below is touched only with `_changed` held, but for `_snapshot`, which one assignment replaces.
        self._frames: deque[DepthFrame] = deque()
        self._saves: deque[tuple[Path, threading.Event, list[BaseException]]] = deque()
        self._received = self._dropped = self._refused = self._used = self._steps = 0
        self._flush_wanted = self._flushed = 0  # frames handed over, frames in a snapshot for sure
        self._closing = False
        self._error: BaseException | None = None
        self._snapshot: Snapshot | None = None
        self._frame_time, self._started = 0.0, time.monotonic()
        self._first_at: float | None = None
        self._worker = threading.Thread(target=self._run, name="isdf-mapper", daemon=True)
        self._worker.start()

    def integrate(self, frame: Any) -> bool:
        """Hand a new frame over; False when the oldest waiting one was dropped for it.

        Raises:
            FrameError: the frame cannot be used by any mapper; nothing has changed.
            BackgroundError: the mapper has failed or is closed.
        """
        frame = DepthFrame.of(frame)
        with self._changed:
            self._check()
            full = len(self._frames) == self._queue_size
            if full:
                self._frames.popleft()
                self._dropped += 1
            self._frames.append(frame)
            self._received += 1
            self._changed.notify_all()
        return not full

    def snapshot(self) -> Snapshot:
        """What was last published; also after `close`.

        Raises:
            NotReadyError: nothing was yet.
            BackgroundError: the mapper has failed: what was published is growing old.
        """
        if self._error is not None:
            self._check()
        if self._snapshot is None:
            raise NotReadyError(
                "no snapshot yet: call integrate(frame), then flush() to wait until it is in the map"
            )
        return self._snapshot

    def field(self) -> Any:
        """The distance field of `snapshot`."""
        return self.snapshot().field

    def flush(self, timeout: float | None = None) -> bool:
        """Wait until all frames handed over are in the published snapshot; False when `timeout` [s] was too short.

        Without it the snapshot of a voxel map is up to its `rebuild_period` older than the newest frame.

        Raises:
            BackgroundError: the mapper has failed or is closed.
        """
        with self._changed:
            self._check()
            wanted = self._flush_wanted = self._received
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._worker.is_alive() or self._flushed >= wanted, timeout)
            if self._flushed < wanted:
                self._check()
            return self._flushed >= wanted

    def save(self, path: str | Path) -> None:
        """Write the map to a file, as the mapper does between two steps; returns when it is written.

        Raises:
            NotReadyError, OSError: what saving the mapper raises.
            BackgroundError: the mapper has failed or is closed.
        """
        done, errors = threading.Event(), []  # type: ignore[var-annotated]
        with self._changed:
            self._check()
            self._saves.append((Path(path), done, errors))
            self._changed.notify_all()
        done.wait()
        if errors:
            raise errors[0]

    def rates(self) -> Rates:
        """What happened since the start."""
        with self._changed:
            last, made = self._snapshot, 0 if self._snapshot is None else self._snapshot.number + 1
            interval = float("nan")
            if last is not None and self._first_at is not None and made > 1:
                interval = (last.made_at - self._first_at) / (made - 1)
            return Rates(
                time.monotonic() - self._started,
                self._received,
                self._used,
                self._dropped,
                self._refused,
                self._steps,
                made,
                interval,
            )

    def close(self, drain: bool = True) -> None:
        """Stop the thread; afterwards `snapshot` and `field` still answer. Twice is once.

        Args:
            drain: map the frames that wait first; else they are dropped.

        Raises:
            BackgroundError: the mapper has failed.
        """
        with self._changed:
            if not drain:
                self._dropped += len(self._frames)
                self._frames.clear()
            self._closing = True
            self._changed.notify_all()
        self._worker.join()
        if self._error is not None:
            self._check()

    def __repr__(self) -> str:
        rates = self.rates()
        state = "failed" if self._error is not None else "closed" if self._closing else "running"
        return (
            f"<BackgroundMapper of {type(self._mapper).__name__}, {state}: {rates.used} frames used, {rates.dropped} "
            f"dropped, {rates.refused} refused, {rates.snapshots} snapshots>"
        )

    def __enter__(self) -> BackgroundMapper:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close(drain=kind is None)
        except BackgroundError:
            if kind is None:  # else the caller's own error matters more
                raise

    def _check(self) -> None:
        if self._error is not None:
            raise BackgroundError(
                f"mapping stopped with {type(self._error).__name__}: {self._error}; make a new mapper, or load a "
                "saved one"
            ) from self._error
        if self._closing:
            raise BackgroundError("this background mapper is closed; make a new one")

    def _handled(self) -> int:
        return self._used + self._refused + self._dropped

    def _flush_due(self) -> bool:
        return self._flushed < self._flush_wanted <= self._handled()

    def _run(self) -> None:
        try:
            while self._turn():
                pass
        except BaseException as error:  # whatever it is, the callers must learn of it
            logger.exception("the background mapper stopped")
            with self._changed:
                self._error = error
        finally:
            with self._changed:
                for _, done, errors in self._saves:
                    errors.append(BackgroundError("the background mapper ended before it could save"))
                    done.set()
                self._saves.clear()
                self._changed.notify_all()

    def _turn(self) -> bool:
        """One frame, one save, or one step of training, then what is to be published; False when all is done."""
        with self._changed:
            save = self._saves.popleft() if self._saves else None
            frame = self._frames.popleft() if self._frames and save is None else None
            ending = self._closing and frame is None and save is None
        if save is not None:
            self._save(*save)
        elif frame is not None:
            self._integrate(frame)
        elif not ending and (self._mapper.frames_seen == 0 or self._mapper.run_for(0.0) == 0):
            self._publish(complete=False)
            with self._changed:
                self._changed.wait_for(
                    lambda: self._frames or self._saves or self._closing or self._flush_due()
                )
        last = self._snapshot
        with self._changed:
            flush = ending or self._flush_due()
        if flush or last is None or time.monotonic() - last.made_at >= self._publish_every:
            self._publish(flush)
        return not ending

    def _integrate(self, frame: DepthFrame) -> None:
        before = self._mapper.frames_seen
        try:
            self._mapper.integrate(frame)
        except FrameError as error:
            logger.warning("frame at %.3f s passed over: %s", frame.time, error)
        used = self._mapper.frames_seen > before
        with self._changed:
            self._used += used
            self._refused += not used
            self._frame_time = frame.time if used else self._frame_time

    def _save(self, path: Path, done: threading.Event, errors: list[BaseException]) -> None:
        try:
            self._mapper.save(path)
        except (NotReadyError, OSError) as error:
            errors.append(error)
        finally:
            done.set()

    def _publish(self, complete: bool) -> None:
        """Replace the snapshot if the map has changed; when `complete`, by one that holds every frame handled."""
        mapper, last = self._mapper, self._snapshot
        handled = self._handled_now()
        if complete and hasattr(mapper, "refresh"):
            mapper.refresh()
        stale = last is None or (mapper.frames_seen, mapper.steps) != (last.frames, last.steps)
        new = self._make_snapshot(last) if mapper.frames_seen and stale else None
        with self._changed:
            self._steps = mapper.steps
            if new is not None:
                self._first_at = new.made_at if self._first_at is None else self._first_at
                self._snapshot = new
            if complete:
                self._flushed = handled
            self._changed.notify_all()

    def _handled_now(self) -> int:
        with self._changed:
            return self._handled()

    def _make_snapshot(self, last: Snapshot | None) -> Snapshot | None:
        """None where there is no surface yet, or the field is that of the last snapshot."""
        mapper = self._mapper
        try:
            field = mapper.field()
        except NotReadyError:
            return None
        if last is not None and field is last.field:
            return None
        number = 0 if last is None else last.number + 1
        return Snapshot(
            field,
            mapper.bounds,
            number,
            mapper.frames_seen,
            mapper.steps,
            self._frame_time,
            time.monotonic(),
        )
