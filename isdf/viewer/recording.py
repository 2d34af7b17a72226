"""States of a run in a folder of numbered files, to be watched again without running it.

Every file is complete when it has its name, so that a run that was killed leaves a recording up to then. Fields are
sampled on a grid; a state names the field and the meshes that it shows, which are written once. There is no pickle in
it.
"""

from __future__ import annotations

import functools
import json
import logging
import queue
import threading
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..atomic import replacing
from ..camera import PinholeCamera
from ..errors import ViewerError
from ..field import ConfidentGridField, grid_points
from .pictures import confidence_of
from .state import Compose, Line, Shape, Spheres, ViewState
from .surface import spacing_for

logger = logging.getLogger(__name__)

FORMAT, VERSION = "isdf-recording", 1
ABOUT = "recording.json"
WAITING = 500
"""States that may wait to be written; more are left out."""
WIDTH = 160
"""Columns of a recorded image, at most."""
STEP = 0.001
"""Distances are kept to this [m]."""


class Recorder:
    """Writes states in a thread of its own.

    Args:
        folder: made if missing; a recording in it is replaced.
        up: direction of the world.
        field_period: least time between two fields, of the states' time [s].
    """

    def __init__(
        self, folder: Path, up: tuple[float, float, float] = (0.0, 0.0, 1.0), field_period: float = 1.0
    ) -> None:
        self.folder, self.field_period = folder, field_period
        self.left_out = 0
        """States that came faster than they could be written."""
        folder.mkdir(parents=True, exist_ok=True)
        for old in [folder / ABOUT, *folder.glob("*_[0-9]*.npz")]:
            old.unlink(missing_ok=True)
        about = {"format": FORMAT, "version": VERSION, "up": [float(v) for v in up]}
        (folder / ABOUT).write_text(json.dumps(about) + "\n")
        self._queue: queue.Queue[Compose | None] = queue.Queue(WAITING)
        self._states = self._fields = 0
        self._field: tuple[Any, float] = (None, -np.inf)
        self._shapes: dict[int, tuple[Shape, int]] = {}
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def add(self, compose: Compose) -> None:
        """Write a state soon; returns at once."""
        try:
            self._queue.put_nowait(compose)
        except queue.Full:
            self.left_out += 1

    def close(self) -> None:
        """Write what is waiting, and end."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        if self.left_out:
            logger.warning("%s: %d states came too fast and were left out", self.folder, self.left_out)

    def _run(self) -> None:
        torch.set_num_threads(1)
        while (compose := self._queue.get()) is not None:
            try:
                self._write(compose())
            except Exception:  # a disk that is full must not end what is recorded
                logger.exception("%s: a state could not be written", self.folder)

    def _write(self, state: ViewState) -> None:
        self._keep_field(state)
        arrays: dict[str, np.ndarray] = {}
        about: dict[str, Any] = {"time": state.time, "status": state.status, "field": self._fields - 1}
        about["shapes"] = {name: self._number_of(shape) for name, shape in state.shapes.items()}
        about["poses"] = {name: np.asarray(pose, float).tolist() for name, pose in state.poses.items()}
        about["goal"] = None if state.goal is None else np.asarray(state.goal, float).tolist()
        about["spheres"] = {n: [list(s.colour), s.opacity] for n, s in state.spheres.items()}
        about["lines"] = {n: [list(line.colour), line.width] for n, line in state.lines.items()}
        for name, balls in state.spheres.items():
            arrays[f"spheres:{name}"] = np.column_stack([balls.centres, balls.radii]).astype(np.float32)
        for name, line in state.lines.items():
            arrays[f"line:{name}"] = np.asarray(line.points, np.float32)
        if state.frame is not None:
            about["camera"], arrays["depth"] = _thinned(state.frame)
            arrays["T_world_camera"] = np.asarray(state.frame.T_world_camera, float)
        _save(self.folder / f"state_{self._states:06d}.npz", about, arrays)
        self._states += 1

    def _keep_field(self, state: ViewState) -> None:
        field, written = self._field
        if state.field is None or state.field is field or state.time < written + self.field_period:
            return
        arrays = sampled(state.field)
        _save(self.folder / f"field_{self._fields:06d}.npz", {}, arrays)
        self._field, self._fields = (state.field, state.time), self._fields + 1

    def _number_of(self, shape: Shape) -> int:
        """Under which number the mesh is kept; written if it is new."""
        if id(shape) not in self._shapes:
            number = len(self._shapes)
            arrays = {
                "vertices": np.asarray(shape.vertices, np.float32),
                "faces": np.asarray(shape.faces, np.uint32),
            }
            _save(self.folder / f"shape_{number:06d}.npz", {"colour": list(shape.colour)}, arrays)
            self._shapes[id(shape)] = shape, number  # kept, so that no other mesh gets its id
        return self._shapes[id(shape)][1]


class Recording:
    """A recording as it is read, state by state.

    Args:
        folder: that a `Recorder` wrote.

    Raises:
        ViewerError: there is no recording, or it is damaged or of another version.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        about = self._about()
        if about.get("format") != FORMAT or about.get("version") != VERSION:
            raise ViewerError(
                f"{folder}: a recording of version {about.get('version')!r}, this reads {VERSION}"
            )
        x, y, z = about["up"]
        self.up = float(x), float(y), float(z)
        self.files = sorted(folder.glob("state_[0-9]*.npz"))
        if not self.files:
            raise ViewerError(f"{folder}: nothing was recorded")
        self.times = [float(_load(path)[0]["time"]) for path in self.files]
        self.field = functools.lru_cache(4)(self._field)
        self.shape = functools.lru_cache(None)(self._shape)

    def __len__(self) -> int:
        return len(self.files)

    def state(self, number: int) -> ViewState:
        """A state as it was."""
        about, arrays = _load(self.files[number])
        spheres = {
            name: Spheres(
                arrays[f"spheres:{name}"][:, :3], arrays[f"spheres:{name}"][:, 3], tuple(colour), opacity
            )
            for name, (colour, opacity) in about["spheres"].items()
        }
        lines = {n: Line(arrays[f"line:{n}"], tuple(c), width) for n, (c, width) in about["lines"].items()}
        frame = None
        if "camera" in about:
            frame = RecordedFrame(
                arrays["depth"].astype(np.float32) / 1000, arrays["T_world_camera"], about["camera"]
            )
        return ViewState(
            about["time"],
            about["status"],
            frame,
            None if about["field"] < 0 else self.field(about["field"]),
            {name: self.shape(n) for name, n in about["shapes"].items()},
            {name: np.array(pose) for name, pose in about["poses"].items()},
            spheres,
            lines,
            None if about["goal"] is None else np.array(about["goal"]),
        )

    def _about(self) -> dict[str, Any]:
        path = self.folder / ABOUT
        try:
            about = json.loads(path.read_text())
        except FileNotFoundError:
            raise ViewerError(f"{self.folder}: no recording there; --record FOLDER makes one") from None
        except (OSError, ValueError) as error:
            raise ViewerError(f"{path}: unreadable ({error})") from error
        return about if isinstance(about, dict) else {}

    def _field(self, number: int) -> ConfidentGridField:
        _, arrays = _load(self.folder / f"field_{number:06d}.npz")
        values = torch.from_numpy(arrays["steps"].astype(np.float32) * STEP)
        sure = torch.from_numpy(arrays["confidence"].astype(np.float32) / 255)
        return ConfidentGridField(values, torch.from_numpy(arrays["origin"]), float(arrays["spacing"]), sure)

    def _shape(self, number: int) -> Shape:
        about, arrays = _load(self.folder / f"shape_{number:06d}.npz")
        return Shape(arrays["vertices"], arrays["faces"], tuple(about["colour"]))


class RecordedFrame:
    """A depth image with its pose, as far as it is shown."""

    def __init__(self, depth: np.ndarray, T_world_camera: np.ndarray, camera: list[float]) -> None:
        height, width = depth.shape
        self.depth, self.T_world_camera = depth, T_world_camera
        fx, fy, cx, cy = camera
        self.camera = PinholeCamera(fx, fy, cx, cy, width, height)


def sampled(field: Any) -> dict[str, np.ndarray]:
    """A distance field on a grid over its bounds: steps of `STEP`, confidences in 0 .. 255, origin and spacing."""
    spacing = spacing_for(field.bounds)
    bounds = field.bounds.float().cpu() + 0.1 * torch.tensor([[-1.0], [1.0]])
    points = grid_points(bounds, spacing)
    steps = np.round(field.distance(points).cpu().numpy() / STEP).clip(-32767, 32767).astype(np.int16)
    sure = np.round(255 * np.clip(confidence_of(field, points), 0, 1)).astype(np.uint8)
    return {"steps": steps, "confidence": sure, "origin": bounds[0].numpy(), "spacing": np.array(spacing)}


def _thinned(frame: Any) -> tuple[list[float], np.ndarray]:
    """fx, fy, cx, cy and the image in millimetres, of at most `WIDTH` columns."""
    camera, depth = frame.camera, np.asarray(frame.depth)
    stride = max(1, -(-camera.width // WIDTH))
    intrinsics = [float(v) / stride for v in (camera.fx, camera.fy, camera.cx, camera.cy)]
    return intrinsics, np.round(1000 * depth[::stride, ::stride]).clip(0, 65535).astype(np.uint16)


def _save(path: Path, about: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]


def _load(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    try:
        with np.load(path, allow_pickle=False) as held:
            arrays = dict(held)
        return json.loads(str(arrays.pop("about"))), arrays
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ViewerError(f"{path}: unreadable ({error}); record again") from error
