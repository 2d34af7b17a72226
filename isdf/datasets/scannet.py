"""ScanNet scenes (Dai et al., CVPR 2017) as the SensReader exports them, which iSDF reads under frames/.

depth/<n>.png                  16-bit PNG in millimetres, 0 invalid
pose/<n>.txt                   4x4 T_world_camera [m], OpenCV axes; -inf where tracking was lost
intrinsic/intrinsic_depth.txt  4x4 camera matrix of the depth images
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..camera import PinholeCamera
from ..errors import DatasetError
from .poses import read_matrices, read_matrix
from .sequence import DEFAULT_FPS, ImageSequence, image_size, matrix_camera, numbered

DEPTH_SCALE = 1000.0


class ScanNetSequence(ImageSequence):
    """An exported ScanNet scene, its images in the scene's folder or in frames/ below it.

    Poses come from pose/, else from a traj.txt in the scene's folder (a matrix for each frame number, as iSDF
    releases them). Intrinsics come from intrinsic/intrinsic_depth.txt, else from the scan's own <scene>.txt.
    Frames exported with a skip keep the time of their number.

    Args:
        folder: one scene, such as scene0031_00.
        fps: frames a second; by default 30 divided by the skip.

    Raises:
        DatasetError: a file is missing or unreadable.
    """

    layout = "ScanNet export"

    def __init__(self, folder: str | Path, fps: float | None = None) -> None:
        folder = Path(folder)
        missing = self.missing(folder)
        if missing:
            raise DatasetError(f"{folder}: not a {self.layout}, {', '.join(missing)} missing")
        images = numbered(_frames(folder) / "depth", "", ".png")
        camera = _read_camera(folder, image_size(next(iter(images.values()))))
        poses = _read_poses(folder, list(images))
        times = np.array(list(images), dtype=np.float64) / DEFAULT_FPS
        super().__init__(folder, list(images.values()), poses, camera, DEPTH_SCALE, fps=fps, times=times)

    @staticmethod
    def missing(folder: Path) -> list[str]:
        """What keeps a folder from having this layout; empty when it has it."""
        frames = _frames(folder)
        missing = [] if numbered(frames / "depth", "", ".png") else ["depth/<n>.png"]
        if not (frames / "pose").is_dir() and not (folder / "traj.txt").is_file():
            missing.append("pose/<n>.txt")
        if not _matrix_file(folder).is_file() and not _metadata_file(folder).is_file():
            missing.append("intrinsic/intrinsic_depth.txt")
        return missing


def _frames(folder: Path) -> Path:
    return folder / "frames" if (folder / "frames").is_dir() else folder


def _matrix_file(folder: Path) -> Path:
    return _frames(folder) / "intrinsic" / "intrinsic_depth.txt"


def _metadata_file(folder: Path) -> Path:
    return folder / f"{folder.resolve().name}.txt"


def _read_camera(folder: Path, size: tuple[int, int]) -> PinholeCamera:
    if _matrix_file(folder).is_file():
        return matrix_camera(_matrix_file(folder), read_matrix(_matrix_file(folder)), size)
    path = _metadata_file(folder)
    pairs = (line.split("=", 1) for line in path.read_text(errors="replace").splitlines() if "=" in line)
    values = {name.strip(): value.strip() for name, value in pairs}
    try:
        fx, fy, cx, cy = (float(values[n]) for n in ("fx_depth", "fy_depth", "mx_depth", "my_depth"))
    except KeyError as error:
        raise DatasetError(f"{path}: {error} missing; export the intrinsics with the SensReader") from error
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from error
    return matrix_camera(path, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), size)


def _read_poses(folder: Path, numbers: list[int]) -> Float[np.ndarray, "n 4 4"]:
    poses = np.full((len(numbers), 4, 4), np.nan)  # a frame without a pose is one where tracking was lost
    files = numbered(_frames(folder) / "pose", "", ".txt")
    if files:
        for row, number in enumerate(numbers):
            if number in files:
                poses[row] = read_matrix(files[number])
    elif (folder / "traj.txt").is_file():
        listed = read_matrices(folder / "traj.txt")
        known = [row for row, number in enumerate(numbers) if number < len(listed)]
        poses[known] = listed[[numbers[row] for row in known]]
    else:
        raise DatasetError(f"{_frames(folder) / 'pose'}: no <n>.txt")
    return poses
