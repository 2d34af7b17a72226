"""TUM RGB-D sequences (Sturm et al., IROS 2012).

depth.txt        a line an image: time stamp [s], file name
depth/*.png      16-bit PNG, 5000 values a metre, 0 invalid
groundtruth.txt  a line a pose: time stamp [s], tx ty tz [m], qx qy qz qw; camera to world, OpenCV axes
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from ..camera import PinholeCamera
from ..errors import DatasetError
from .poses import from_quaternions, poses_at, read_table
from .sequence import ImageSequence

DEPTH_SCALE = 5000.0
# The calibrations that the data set's page gives, by Freiburg number. Depth is registered to these colour cameras.
CAMERAS = {
    "1": PinholeCamera(517.3, 516.5, 318.6, 255.3, 640, 480),
    "2": PinholeCamera(520.9, 521.0, 325.1, 249.7, 640, 480),
    "3": PinholeCamera(535.4, 539.2, 320.1, 247.6, 640, 480),
}


class TumSequence(ImageSequence):
    """A TUM RGB-D sequence; depth images without a motion-capture pose near in time are frames without a pose.

    Args:
        folder: one sequence, such as rgbd_dataset_freiburg1_desk; the number in its name chooses the camera.
        fps: frames a second; by default from the time stamps.
        camera: intrinsics, where the name holds no freiburg1, 2 or 3 (or fr1, fr2, fr3).
        tolerance: the nearest pose may be this far away in time [s]; 0.02 as in the data set's own tools.
        interpolate: between the poses before and after; else the nearest one. The camera moves about a
            centimetre in 20 ms when carried briskly.

    Raises:
        DatasetError: a file is missing or unreadable, the camera is unknown, or no image has a pose.
    """

    layout = "TUM RGB-D"

    def __init__(
        self,
        folder: str | Path,
        fps: float | None = None,
        camera: PinholeCamera | None = None,
        tolerance: float = 0.02,
        interpolate: bool = True,
    ) -> None:
        folder = Path(folder)
        missing = self.missing(folder)
        if missing:
            raise DatasetError(f"{folder}: not a {self.layout} sequence, {', '.join(missing)} missing")
        camera = camera or _camera_by_name(folder)
        stamps, images = _read_list(folder / "depth.txt")
        truth = read_table(folder / "groundtruth.txt", 8)
        measured = from_quaternions(truth[:, 1:4], truth[:, 4:])
        poses = poses_at(stamps, truth[:, 0], measured, tolerance, interpolate)
        if not np.isfinite(poses).any():
            raise DatasetError(
                f"{folder}: no depth image has a pose within {tolerance} s; depth.txt begins at {stamps[0]:.3f}, "
                f"groundtruth.txt at {truth[0, 0]:.3f}"
            )
        files = [folder / name for name in images]
        super().__init__(folder, files, poses, camera, DEPTH_SCALE, fps=fps, times=stamps)

    @staticmethod
    def missing(folder: Path) -> list[str]:
        """What keeps a folder from having this layout; empty when it has it."""
        return [n for n in ("depth.txt", "groundtruth.txt") if not (folder / n).is_file()]


def _camera_by_name(folder: Path) -> PinholeCamera:
    found = re.search(r"(?:freiburg|fr)([123])(?!\d)", folder.resolve().name)
    if found is None:
        raise DatasetError(
            f"{folder}: which TUM camera took it is unknown; rename the folder so that it holds freiburg1, "
            "freiburg2 or freiburg3, or pass TumSequence(folder, camera=isdf.PinholeCamera(...))"
        )
    return CAMERAS[found.group(1)]


def _read_list(path: Path) -> tuple[np.ndarray, list[str]]:
    stamps, names = [], []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            stamp, name = words
            stamps.append(float(stamp))
            if not math.isfinite(stamps[-1]):
                raise ValueError(f"a time stamp of {stamp} s")
        except ValueError as error:
            raise DatasetError(
                f"{path}:{number}: expected a time stamp and a file name, got {line!r}"
            ) from error
        names.append(name)
    if not stamps:
        raise DatasetError(f"{path}: no images")
    return np.array(stamps), names
