"""`isdf view`: a recording, or a finished map, in the browser."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from tqdm import tqdm

from ..commands import Outcome, map_file
from ..errors import ViewerError
from ..methods import load_map
from .recording import ABOUT, Recording
from .replay import Replay, show_map
from .viewer import Viewer


@dataclass(frozen=True)
class View:
    """Watch a recording, or look at a finished map, in the browser; until Ctrl-C."""

    path: tyro.conf.Positional[Path]
    """Folder that --record wrote, or a map: the folder of `isdf map` or a map file."""
    port: int = 8080
    """Of the page; the next free one where it is taken."""
    seconds: float | None = None
    """End after so much time [s]; by default not before Ctrl-C."""
    json: bool = False
    """Print the outcome as one line of JSON."""

    def run(self) -> Outcome:
        """Open the page and serve it."""
        recording = Recording(self.path) if (self.path / ABOUT).exists() else None
        if recording is None and not map_file(self.path).is_file():
            raise ViewerError(f"{self.path}: neither a recording (--record FOLDER makes one) nor a map")
        end = None if self.seconds is None else time.monotonic() + self.seconds
        up = (0.0, 0.0, 1.0) if recording is None else recording.up
        with Viewer(self.port, up, goal_moves=False) as viewer, tqdm(desc=viewer.url, bar_format="{desc}"):
            try:
                if recording is None:
                    show_map(load_map(map_file(self.path)).field(), viewer, str(self.path))
                    while end is None or time.monotonic() < end:
                        time.sleep(0.1)
                else:
                    Replay(recording, viewer).run(lambda: end is not None and time.monotonic() >= end)
            except KeyboardInterrupt:
                pass
        kind = "map" if recording is None else f"recording of {len(recording)} states"
        return Outcome(f"{self.path}: {kind}, was at {viewer.url}", {"kind": kind, "url": viewer.url})
