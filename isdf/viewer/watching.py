"""Watching a sequence being mapped: in the browser, and for a recording."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ..datasets import DepthSequence
from ..errors import NotReadyError
from ..frames import DepthFrame
from ..methods import OnlineMapper
from ..slices import estimate_up
from .recording import Recorder
from .state import Compose, Line, ViewState
from .viewer import Viewer

logger = logging.getLogger(__name__)

SHOWN_EVERY, RECORDED_EVERY, FIELD_EVERY = 0.1, 0.2, 0.5
"""Least times between two states shown [s of wall time], recorded [s of sequence], and between two fields [s]."""
WAY_COLOUR = (215, 50, 40)


class Watching:
    """Shows and records a run; a context manager that stays, when the run is done, until nobody watches any more.

    Args:
        sequence: that is mapped; `watching.sequence` is to be mapped in its place, which remembers the last frame.
        port: of the viewer's page; no viewer if None.
        record: folder for a recording; none if None.
        up: direction of the world; judged from the camera poses if None.
    """

    def __init__(
        self,
        sequence: DepthSequence,
        port: int | None,
        record: Path | None,
        up: tuple[float, float, float] | None = None,
    ) -> None:
        self.sequence = _Remembering(sequence)
        finite = sequence.poses[np.isfinite(sequence.poses).all(axis=(1, 2))]
        self._cameras = finite[:, :3, 3]
        x, y, z = up or (estimate_up(finite).tolist() if len(finite) else (0.0, 0.0, 1.0))
        self.viewer = None if port is None else Viewer(port, (x, y, z))
        self.recorder = None if record is None else Recorder(record, (x, y, z))
        self._field: Any = None
        self._field_at = self._shown_at = self._recorded_at = -np.inf

    def timer(self) -> float:
        """CPU time of this process without the viewer's [s]."""
        return time.process_time() - (self.viewer.cpu_seconds() if self.viewer else 0.0)

    def update(self, mapper: OnlineMapper, arrived: int, stopping: Callable[[], bool]) -> None:
        """Show how far the map is; wait while somebody has paused, but not once `stopping`."""
        now, at = time.monotonic(), arrived / self.sequence.fps
        show = self.viewer is not None and now >= self._shown_at + SHOWN_EVERY and self.viewer.watched
        record = self.recorder is not None and at >= self._recorded_at + RECORDED_EVERY
        if show or record:
            compose = self._composer(mapper, arrived, at, now)
            if show and self.viewer is not None:
                self.viewer.show(compose)
                self._shown_at = now
            if record and self.recorder is not None:
                self.recorder.add(compose)
                self._recorded_at = at
        viewer = self.viewer
        if viewer is not None and viewer.controls.hold(lambda: viewer.watched and not stopping()):
            self._shown_at = self._field_at = -np.inf

    def __enter__(self) -> Watching:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.recorder is not None:
            self.recorder.close()
        if self.viewer is not None:
            try:
                if kind is None and self.viewer.watched:
                    logger.warning("done; close the viewer's page or press Ctrl-C to end")
                    self.viewer.linger()
            except KeyboardInterrupt:
                pass
            self.viewer.close()

    def _composer(self, mapper: OnlineMapper, arrived: int, at: float, now: float) -> Compose:
        if now >= self._field_at + FIELD_EVERY:
            with contextlib.suppress(NotReadyError):
                self._field, self._field_at = mapper.field(), now
        steps = f", {mapper.steps} steps" if mapper.steps else ""
        status = f"frame {arrived} of {len(self.sequence)}, {mapper.frames_seen} used{steps}"
        frame, field, way = self.sequence.last, self._field, Line(self._cameras[:arrived], WAY_COLOUR, 0.012)
        return lambda: ViewState(at, status, frame, field, lines={"camera path": way})


class _Remembering:
    """A sequence that remembers the last frame that was read."""

    def __init__(self, sequence: DepthSequence) -> None:
        self._sequence = sequence
        self.folder, self.camera, self.fps, self.poses = (
            sequence.folder, sequence.camera, sequence.fps, sequence.poses,
        )  # fmt: skip
        self.last: DepthFrame | None = None

    def __len__(self) -> int:
        return len(self._sequence)

    def __getitem__(self, i: int) -> DepthFrame:
        self.last = self._sequence[i]
        return self.last
