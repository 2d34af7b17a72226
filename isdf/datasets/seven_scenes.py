"""7-Scenes sequences (Shotton et al., CVPR 2013), and others that name their files alike.

frame-%06d.depth.png  16-bit PNG in millimetres, 65535 invalid
frame-%06d.pose.txt   4x4 T_world_camera [m], OpenCV axes
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..camera import PinholeCamera
from ..errors import DatasetError
from .poses import read_matrix, read_table
from .sequence import DEFAULT_FPS, ImageSequence, image_size, matrix_camera, numbered

DEPTH_SCALE = 1000.0
INVALID = (0.0, 65535.0)
# The nominal Kinect intrinsics that the data set's page gives; it publishes no calibration.
NOMINAL_CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, 640, 480)


class SevenScenesSequence(ImageSequence):
    """One sequence of a scene. A camera-intrinsics.txt (3x3) beside the frames overrules the nominal camera.

    Args:
        folder: one sequence, such as chess/seq-01.
        fps: frames a second; by default 30, less where frames were left out.

    Raises:
        DatasetError: a file is missing or unreadable.
    """

    layout = "7-Scenes"

    def __init__(self, folder: str | Path, fps: float | None = None) -> None:
        folder = Path(folder)
        missing = self.missing(folder)
        if missing:
            raise DatasetError(f"{folder}: not a {self.layout} sequence, {', '.join(missing)} missing")
        images = numbered(folder, "frame-", ".depth.png")
        poses = np.full((len(images), 4, 4), np.nan)
        files = numbered(folder, "frame-", ".pose.txt")
        for row, number in enumerate(images):
            if number in files:  # a frame without a pose is one where tracking was lost
                poses[row] = read_matrix(files[number])
        camera, calibration = NOMINAL_CAMERA, folder / "camera-intrinsics.txt"
        if calibration.is_file():
            size = image_size(next(iter(images.values())))
            camera = matrix_camera(calibration, read_table(calibration, 3), size)
        times = np.array(list(images), dtype=np.float64) / DEFAULT_FPS
        super().__init__(folder, list(images.values()), poses, camera, DEPTH_SCALE, INVALID, fps, times)

    @staticmethod
    def missing(folder: Path) -> list[str]:
        """What keeps a folder from having this layout; empty when it has it."""
        names = {"frame-%06d.depth.png": ".depth.png", "frame-%06d.pose.txt": ".pose.txt"}
        missing = [name for name, suffix in names.items() if not numbered(folder, "frame-", suffix)]
        sequences = sorted(p.name for p in folder.glob("seq-*") if p.is_dir())
        if missing and sequences:
            missing[0] += f" (it holds {', '.join(sequences)}: give one of them)"
        return missing
