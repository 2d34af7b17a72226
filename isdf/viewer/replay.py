"""Watching a recording, or a map that is finished, in the viewer."""

from __future__ import annotations

import time
from collections.abc import Callable

from .recording import Recording
from .state import ViewState
from .viewer import Viewer


class Replay:
    """Plays a recording in a viewer with its play, pause and step, and a slider over its moments.

    Args:
        recording: what is played.
        viewer: where.
    """

    def __init__(self, recording: Recording, viewer: Viewer) -> None:
        self.recording, self.viewer = recording, viewer
        self.number = 0
        seconds = recording.times[-1] - recording.times[0]
        viewer.panel.add_moments(len(recording), seconds, self._go_to)
        self._show()

    def run(self, until: Callable[[], bool]) -> None:
        """Play on at the pace of the recording until `until` says to end; the last state stays."""
        times, shown = self.recording.times, time.monotonic()
        while not until():
            last = self.number == len(times) - 1
            gap = 0.0 if last else times[self.number + 1] - times[self.number]
            due = self.viewer.controls.paused or time.monotonic() - shown >= gap
            if last or not self.viewer.watched or not due or not self.viewer.controls.may_go():
                time.sleep(0.01)
                continue
            shown = time.monotonic()
            self.number += 1
            self._show()

    def _go_to(self, number: int) -> None:
        self.viewer.controls.pause()
        self.number = number
        self._show()

    def _show(self) -> None:
        number = self.number
        if self.viewer.panel.moment.value != number:
            self.viewer.panel.moment.value = number
        self.viewer.show(lambda: self.recording.state(number))


def show_map(field: object, viewer: Viewer, status: str) -> None:
    """A finished map."""
    viewer.show(lambda: ViewState(status=status, field=field))
