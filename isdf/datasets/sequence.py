"""What every depth sequence offers, and the base of those kept as one image file a frame."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from PIL import Image

from ..camera import PinholeCamera
from ..errors import CameraError, DatasetError
from ..frames import DepthFrame

DEFAULT_FPS = 30.0
# What Pillow raises at damaged or gigantic images, by where the damage is.
UNREADABLE = (OSError, SyntaxError, ValueError, struct.error, zlib.error, Image.DecompressionBombError)


@runtime_checkable
class DepthSequence(Protocol):
    """Posed depth images in the order they were taken, read one by one.

    `folder` is where they are, `fps` the frames a second, `poses` all T_world_camera (n, 4, 4) [m] with OpenCV
    camera axes; NaN or inf where the camera was lost. Reading such a frame raises FrameError.
    """

    folder: Path
    camera: PinholeCamera
    fps: float
    poses: Float[np.ndarray, "n 4 4"]

    def __len__(self) -> int: ...

    def __getitem__(self, i: int) -> DepthFrame: ...


class ImageSequence:
    """Depth images in files, with a pose each.

    Args:
        folder: the sequence's folder.
        images: a file a frame, in order.
        poses: T_world_camera [m], OpenCV camera axes; not finite where the camera was lost.
        camera: intrinsics of every frame.
        depth_scale: image values a metre.
        invalid: image values that are no measurement.
        fps: frames a second; by default what `times` says, else 30.
        times: when each image was taken [s]; used only where `fps` is not given.

    Raises:
        DatasetError: no images, or fps is not positive.
    """

    def __init__(
        self,
        folder: Path,
        images: Sequence[Path],
        poses: Float[np.ndarray, "n 4 4"],
        camera: PinholeCamera,
        depth_scale: float,
        invalid: tuple[float, ...] = (0.0,),
        fps: float | None = None,
        times: Float[np.ndarray, "n"] | None = None,
    ) -> None:
        if not images:
            raise DatasetError(f"{folder}: no depth images")
        self.folder, self.images, self.poses, self.camera = folder, list(images), poses, camera
        self.depth_scale, self.invalid = depth_scale, invalid
        self.fps, self.times = frame_clock(len(images), fps, times)

    def __len__(self) -> int:
        return len(self.images)

    def __iter__(self) -> Iterator[DepthFrame]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> DepthFrame:
        """Frame i, its time counted from the first.

        Raises:
            DatasetError: its image is missing or unreadable.
            FrameError: its pixels or its pose cannot be used.
        """
        depth = read_depth(self.images[i], self.depth_scale, self.invalid)
        return DepthFrame(depth, self.poses[i], self.camera, time=float(self.times[i]))


def frame_clock(
    count: int, fps: float | None, times: Float[np.ndarray, "n"] | None = None
) -> tuple[float, Float[np.ndarray, "n"]]:
    """Frames a second and the time of every frame [s] from the first; a given rate overrules recorded times."""
    if fps is not None and not fps > 0:
        raise DatasetError(f"fps must be positive, got {fps}")
    if fps is None and times is not None:
        times = times - times[0]
        return (float((count - 1) / times[-1]) if times[-1] > 0 else DEFAULT_FPS), times
    rate = float(fps or DEFAULT_FPS)
    return rate, np.arange(count) / rate


def read_depth(path: Path, depth_scale: float, invalid: tuple[float, ...] = (0,)) -> Float[np.ndarray, "h w"]:
    """A depth image in metres, 0 where invalid."""
    try:
        with Image.open(path) as image:
            values = np.array(image)
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: missing, though the sequence has a pose for it") from error
    except UNREADABLE as error:
        raise DatasetError(f"{path}: not a readable image ({error})") from error
    if values.ndim != 2:
        raise DatasetError(f"{path}: a depth image has one channel, this one has shape {values.shape}")
    depth = values.astype(np.float32) / depth_scale
    depth[np.isin(values, invalid)] = 0
    return depth


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file [pixels]."""
    try:
        with Image.open(path) as image:
            return image.size
    except UNREADABLE as error:
        raise DatasetError(f"{path}: not a readable image ({error})") from error


def matrix_camera(path: Path, K: Float[np.ndarray, "r c"], size: tuple[int, int]) -> PinholeCamera:
    """The pinhole camera of a 3x3 or 4x4 camera matrix read from `path` and a (width, height) [pixels]."""
    if min(K.shape) < 3:
        raise DatasetError(f"{path}: expected a 3x3 or 4x4 camera matrix, got shape {K.shape}")
    try:
        return PinholeCamera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *size)
    except CameraError as error:
        raise DatasetError(f"{path}: {error}") from error


def numbered(folder: Path, prefix: str, suffix: str) -> dict[int, Path]:
    """Files named prefix + number + suffix, by number, in order; empty where the folder is missing."""
    found = {}
    for path in folder.glob(f"{prefix}*{suffix}"):
        digits = path.name[len(prefix) : len(path.name) - len(suffix)]
        if digits.isdecimal():
            found[int(digits)] = path
    return dict(sorted(found.items()))
