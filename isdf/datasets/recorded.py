"""The recorded-sequence folder format.

depth/%06d.png   16-bit PNG, metres = value / depth_scale; 0 and the listed invalid values are no measurement
poses.txt        a line a frame: index, then 16 numbers, row-major T_world_camera [m], OpenCV camera axes
intrinsics.json  fx fy cx cy width height depth_scale, optionally fps and invalid_values (or invalid)
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from ..camera import PinholeCamera
from ..errors import DatasetError
from ..frames import as_camera
from .sequence import DEFAULT_FPS, ImageSequence

MAX_DEPTH_VALUE = 65535


class RecordedSequence(ImageSequence):
    """A folder of depth images with poses and intrinsics, read frame by frame.

    Args:
        folder: the sequence folder.
        fps: frames a second; by default what intrinsics.json says, else 30. Frame i is taken at i / fps.

    Raises:
        DatasetError: a file is missing or unreadable; the message names it.
    """

    layout = "recorded folder"

    def __init__(self, folder: str | Path, fps: float | None = None) -> None:
        folder = Path(folder)
        missing = self.missing(folder)
        if missing:
            raise DatasetError(
                f"{folder}: not a recorded sequence, {', '.join(missing)} missing; expected depth/%06d.png, "
                "poses.txt and intrinsics.json"
            )
        camera, scale, invalid, recorded_fps = _read_intrinsics(folder / "intrinsics.json")
        self.indices, poses = _read_poses(folder / "poses.txt")
        images = [folder / "depth" / f"{index:06d}.png" for index in self.indices]
        super().__init__(folder, images, poses, camera, scale, invalid, fps or recorded_fps or DEFAULT_FPS)

    @staticmethod
    def missing(folder: Path) -> list[str]:
        """What keeps a folder from having this layout; empty when it has it."""
        return [n for n in ("depth", "poses.txt", "intrinsics.json") if not (folder / n).exists()]


class SequenceWriter:
    """Writes a recorded sequence; usable again by `RecordedSequence` after every frame.

    Args:
        folder: made if missing; must not hold a sequence already.
        camera: intrinsics of every frame, a PinholeCamera or any object with its attributes.
        fps: frames a second.
        depth_scale: values a metre; 5000 keeps 0.2 mm and reaches 13 m.
    """

    def __init__(
        self, folder: str | Path, camera: Any, fps: float = DEFAULT_FPS, depth_scale: float = 5000.0
    ) -> None:
        self.folder, self.camera, self.depth_scale = Path(folder), as_camera(camera), depth_scale
        if (self.folder / "poses.txt").exists():
            raise DatasetError(f"{self.folder} already holds a sequence; choose an empty folder")
        (self.folder / "depth").mkdir(parents=True, exist_ok=True)
        names = ("fx", "fy", "cx", "cy", "width", "height")
        values = {n: getattr(self.camera, n) for n in names} | {"depth_scale": depth_scale, "fps": fps}
        (self.folder / "intrinsics.json").write_text(json.dumps(values, indent=1) + "\n")
        (self.folder / "poses.txt").write_text(
            "# frame T_world_camera (4x4 row-major, OpenCV axes, metres)\n"
        )
        self.count = 0

    def write(self, depth: np.ndarray, T_world_camera: np.ndarray) -> None:
        """Append a (h, w) depth image [m] (0, NaN, inf or out of range = invalid) and its (4, 4) pose."""
        scaled = np.nan_to_num(np.asarray(depth, dtype=np.float64) * self.depth_scale, posinf=0, neginf=0)
        scaled[(scaled < 0) | (scaled >= MAX_DEPTH_VALUE)] = 0
        image = Image.fromarray(np.rint(scaled).astype(np.uint16))
        image.save(self.folder / "depth" / f"{self.count:06d}.png")
        numbers = " ".join(repr(float(x)) for x in np.asarray(T_world_camera, dtype=np.float64).ravel())
        with (self.folder / "poses.txt").open("a") as file:
            file.write(f"{self.count} {numbers}\n")
        self.count += 1


def _read_intrinsics(path: Path) -> tuple[PinholeCamera, float, tuple[float, ...], float | None]:
    try:
        values: dict[str, Any] = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: not valid JSON ({error})") from error
    names = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
    missing = [n for n in names if not isinstance(values, dict) or n not in values]
    if missing:
        raise DatasetError(f"{path}: {', '.join(missing)} missing")
    try:
        fx, fy, cx, cy = (float(values[n]) for n in names[:4])
        camera = PinholeCamera(fx, fy, cx, cy, int(values["width"]), int(values["height"]))
        scale, fps = float(values["depth_scale"]), values.get("fps")
        invalid = values.get("invalid_values", values.get("invalid", []))
        fps = None if fps is None else float(fps)
        invalid = (0.0, *(float(v) for v in invalid))
    except (TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"{path}: {error}") from error
    if not scale > 0:
        raise DatasetError(f"{path}: depth_scale must be positive (values a metre), got {scale}")
    return camera, scale, invalid, fps


def _read_poses(path: Path) -> tuple[list[int], Float[np.ndarray, "n 4 4"]]:
    indices, poses = [], []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if len(words) != 17:
            raise DatasetError(f"{path}:{number}: expected an index and 16 numbers, got {len(words)} words")
        try:
            indices.append(int(words[0]))
            poses.append(np.array([float(w) for w in words[1:]]).reshape(4, 4))
        except ValueError as error:
            raise DatasetError(f"{path}:{number}: {error}") from error
    if not indices:
        raise DatasetError(f"{path}: no poses")
    return indices, np.stack(poses)
