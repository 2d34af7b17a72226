"""The live viewer: a web server and a thread that draws the newest state at its own pace."""

from __future__ import annotations

import contextlib
import io
import logging
import threading
import time
from types import TracebackType
from typing import Any

import numpy as np
import torch

from ..errors import ViewerError
from ..slice_geometry import corners
from .controls import Controls
from .mailbox import Mailbox
from .panel import Panel
from .pictures import slice_picture
from .stage import Stage
from .state import Compose, ViewState
from .surface import surface_of

logger = logging.getLogger(__name__)

SURFACE_PERIOD, SURFACE_SHARE = 1.0, 0.15
"""Least time [s] between two meshes of the map, and the share of one core that making them may take."""
DRAW_PERIOD = 0.08
"""Least time [s] between two states."""
GROWN = 1.15
"""A map larger by this factor is looked at from farther away."""


class Viewer:
    """Shows states to whoever opens its page; the program that maps never waits for it.

    Nothing is drawn, meshed or sent while no browser is connected. Usable as a context manager.

    Args:
        port: of the page; the next free one where it is taken.
        up: direction of the world, of any length.
        goal_moves: whether a goal that is shown may be dragged.
        host: address to listen at; by default only this machine can connect.

    Raises:
        ViewerError: viser is not installed.
    """

    def __init__(
        self,
        port: int = 8080,
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        goal_moves: bool = True,
        host: str = "localhost",
    ) -> None:
        others = set(threading.enumerate())
        self.controls = Controls()
        self._up = np.asarray(up, dtype=float) / np.linalg.norm(up)
        with contextlib.redirect_stdout(io.StringIO()):  # its banner
            self.server = _viser().ViserServer(host, port, label="isdf", verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self.stage = Stage(self.server, self._up, self.controls.move_goal if goal_moves else None)
        self.panel = Panel(self.server, self.controls, self.stage.set_visible, goal_moves)
        self.url = f"http://localhost:{self.server.get_port()}"
        self._mailbox: Mailbox[Compose] = Mailbox()
        self._field: Any = None
        self._meshed: Any = None
        self._mesh_at = 0.0
        self._framed: tuple[float, np.ndarray] = (
            0.0,
            np.zeros(3),
        )  # extent of what is looked at [m], and from where
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()
        self._threads = [t for t in threading.enumerate() if t not in others]
        self._spent = 0.0

    def show(self, compose: Compose) -> None:
        """Show a state soon, unless a newer one comes before; returns at once.

        Args:
            compose: makes the state, in the viewer's thread.
        """
        self._mailbox.put(compose)

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return not self._closing.is_set() and bool(self.server.get_clients())

    def hold(self) -> bool:
        """Wait while somebody who watches has paused; returns whether it waited."""
        return self.controls.hold(lambda: self.watched)

    def linger(self) -> None:
        """Stay until nobody watches any more."""
        while self.watched:
            time.sleep(0.1)

    def cpu_seconds(self) -> float:
        """What the viewer's own threads have used so far: no part of what mapping costs."""
        if not self._closing.is_set() and hasattr(time, "pthread_getcpuclockid"):
            alive = [t.ident for t in self._threads if t.is_alive() and t.ident is not None]
            self._spent = max(
                self._spent, sum(time.clock_gettime(time.pthread_getcpuclockid(ident)) for ident in alive)
            )
        return self._spent

    def close(self) -> None:
        """Shut the page down."""
        if not self._closing.is_set():
            self.cpu_seconds()
            self._closing.set()
            self._thread.join(timeout=10.0)
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        torch.set_num_threads(1)
        while not self._closing.is_set():
            if not self.watched:
                self._closing.wait(0.05)
                continue
            try:
                self._turn()
            except Exception:  # a picture that fails must not end the others, nor what is watched
                logger.exception("the viewer could not draw")
                self._closing.wait(1.0)

    def _turn(self) -> None:
        """Draw what is new."""
        started = time.monotonic()
        compose = self._mailbox.take(DRAW_PERIOD)
        if compose is not None:
            state = compose()
            with self.server.atomic():  # so that a browser shows all of it at once
                self._draw(state)
        if self.panel.changed:
            self._draw_slice()
        if self._field is not self._meshed and time.monotonic() >= self._mesh_at:
            self._draw_surface()
        self._closing.wait(max(0.0, DRAW_PERIOD - (time.monotonic() - started)))

    def _draw(self, state: ViewState) -> None:
        self.panel.show(state)
        self.stage.draw(state)
        if state.field is not None and state.field is not self._field:
            self._field = state.field
            along = corners(state.field.bounds.cpu().numpy()) @ self._up
            self.panel.set_range(float(along.min()), float(along.max()))
            self._draw_slice()
            self._frame_view(state.field.bounds.cpu().numpy())

    def _draw_slice(self) -> None:
        self.panel.changed = False
        if self._field is not None:
            panel = self.panel
            self.stage.draw_slice(
                slice_picture(self._field, panel.height, self._up, panel.quantity, panel.fade)
            )

    def _draw_surface(self) -> None:
        began, field = time.monotonic(), self._field
        self.stage.draw_surface(surface_of(field))
        self._meshed, took = field, time.monotonic() - began
        self._mesh_at = began + max(SURFACE_PERIOD, took / SURFACE_SHARE)

    def _frame_view(self, bounds: np.ndarray) -> None:
        """Look at the map from obliquely above; again when it has grown, for those who have not moved their camera."""
        low, high = bounds
        extent, before = self._framed
        span = float(np.linalg.norm(high - low))
        if span < GROWN * extent:
            return
        middle, aside = (low + high) / 2, np.eye(3)[int(np.abs(self._up).argmin())]
        back = np.cross(aside, self._up)
        eye = middle + span * (0.6 * self._up + 0.45 * back / np.linalg.norm(back))
        self.server.initial_camera.position, self.server.initial_camera.look_at = eye, middle
        for client in self.server.get_clients().values():
            if extent == 0.0 or np.linalg.norm(client.camera.position - before) < 0.01:
                client.camera.position, client.camera.look_at = eye, middle
        self._framed = (span, eye)


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise ViewerError("the viewer needs viser: pip install 'isdf-planning[viewer]'") from error
    return viser
