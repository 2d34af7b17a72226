"""Raw data exported by the Polycam scanner from phones and tablets with LiDAR.

keyframes/depth/<t>.png               16-bit PNG in millimetres, <t> in microseconds
keyframes/confidence/<t>.png          8-bit PNG of the same size: 0 low, 127 medium, 255 high; optional
keyframes/corrected_cameras/<t>.json  fx fy cx cy width height of the colour image, and rows 0..2 of
                                      T_world_camera as t_00 .. t_23 [m]; cameras/ where it is absent

The world is ARKit's, +y up. Its camera axes are OpenGL's: x right, y up, z backward.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..camera import PinholeCamera
from ..errors import CameraError, DatasetError
from ..frames import DepthFrame
from .sequence import ImageSequence, image_size, numbered, read_depth

DEPTH_SCALE = 1000.0
MICROSECONDS = 1e-6
# Beyond the sensor's range the app's depth is invented [m].
LIDAR_RANGE = 5.0
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


class PolycamSequence(ImageSequence):
    """A Polycam capture; every frame has its own intrinsics, as the phone's lens focuses.

    Pixels of low confidence, or beyond the range of the LiDAR, are no measurement.

    Args:
        folder: the capture, which holds keyframes/.
        fps: frames a second; by default from the time stamps.

    Raises:
        DatasetError: a file is missing or unreadable.
    """

    layout = "Polycam raw data"

    def __init__(self, folder: str | Path, fps: float | None = None) -> None:
        folder = Path(folder)
        missing = self.missing(folder)
        if missing:
            raise DatasetError(f"{folder}: not a {self.layout} export, {', '.join(missing)} missing")
        images, cameras = numbered(folder / "keyframes" / "depth", "", ".png"), _cameras(folder)
        images = {stamp: path for stamp, path in images.items() if stamp in cameras}
        if not images:
            raise DatasetError(f"{folder}: no depth image has the name of a camera file")
        size = image_size(next(iter(images.values())))
        self.cameras, poses = [], []
        for stamp in images:
            camera, pose = _read_camera(cameras[stamp], size)
            self.cameras.append(camera)
            poses.append(pose)
        times = np.array(list(images), dtype=np.float64) * MICROSECONDS
        files = list(images.values())
        super().__init__(folder, files, np.stack(poses), self.cameras[0], DEPTH_SCALE, fps=fps, times=times)

    def __getitem__(self, i: int) -> DepthFrame:
        """Frame i with its own intrinsics; raises as `ImageSequence` does."""
        path = self.images[i]
        depth = read_depth(path, self.depth_scale, self.invalid)
        depth[depth > LIDAR_RANGE] = 0
        confidence = path.parent.parent / "confidence" / path.name
        if confidence.is_file():
            trusted = read_depth(confidence, 1.0)
            if trusted.shape != depth.shape:
                raise DatasetError(
                    f"{confidence}: has shape {trusted.shape}, its depth image {depth.shape}; export it again"
                )
            depth[trusted == 0] = 0
        return DepthFrame(depth, self.poses[i], self.cameras[i], time=float(self.times[i]))

    @staticmethod
    def missing(folder: Path) -> list[str]:
        """What keeps a folder from having this layout; empty when it has it."""
        missing = []
        if not numbered(folder / "keyframes" / "depth", "", ".png"):
            missing.append("keyframes/depth/<t>.png")
        if not _cameras(folder):
            missing.append("keyframes/corrected_cameras/<t>.json (or keyframes/cameras)")
        return missing


def _cameras(folder: Path) -> dict[int, Path]:
    corrected = numbered(folder / "keyframes" / "corrected_cameras", "", ".json")
    return corrected or numbered(folder / "keyframes" / "cameras", "", ".json")


def _read_camera(path: Path, size: tuple[int, int]) -> tuple[PinholeCamera, np.ndarray]:
    """Intrinsics scaled to a (width, height) of the depth image [pixels], and T_world_camera with OpenCV axes."""
    try:
        values = json.loads(path.read_text())
        fx, fy, cx, cy = (float(values[n]) for n in ("fx", "fy", "cx", "cy"))
        across, down = size[0] / float(values["width"]), size[1] / float(values["height"])
        pose = np.eye(4)
        pose[:3] = [[float(values[f"t_{i}{j}"]) for j in range(4)] for i in range(3)]
        # Pixel centres are at whole numbers, so half a pixel is added before and taken off after scaling.
        centre = (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5
        camera = PinholeCamera(fx * across, fy * down, *centre, *size)
    except KeyError as error:
        raise DatasetError(f"{path}: {error} missing") from error
    except (OSError, TypeError, ValueError, ArithmeticError, CameraError) as error:
        raise DatasetError(f"{path}: {error}") from error
    return camera, pose @ OPENGL_FROM_OPENCV
