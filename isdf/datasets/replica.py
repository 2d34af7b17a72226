"""Rendered Replica-style sequences: the ReplicaCAD release of iSDF, and Replica as NICE-SLAM distributes it.

Both keep results/depth%06d.png and traj.txt (row-major T_world_camera a line, OpenCV axes); they differ in depth
scale by a factor of two, so each is accepted only by what tells it from the other.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..camera import PinholeCamera
from ..errors import DatasetError
from .poses import read_matrices
from .sequence import ImageSequence, numbered

# The renderer's 16-bit images saturate at the end of their range: no surface is known there.
INVALID = (0.0, 65535.0)


class ReplicaCadSequence(ImageSequence):
    """A ReplicaCAD sequence as released with iSDF (Ortiz et al., RSS 2022).

    Args:
        folder: one sequence, such as apt_2_nav.
        fps: frames a second; 30 by default.
        noisy: results/ndepth%06d.png, with simulated sensor noise as in the paper's experiments; else the clean
            results/depth%06d.png.

    Raises:
        DatasetError: a file is missing or unreadable.
    """

    layout = "ReplicaCAD (iSDF release)"
    camera_of_release = PinholeCamera(600.0, 600.0, 599.5, 339.5, 1200, 680)
    depth_scale_of_release = 3276.75

    def __init__(self, folder: str | Path, fps: float | None = None, noisy: bool = True) -> None:
        folder, prefix = Path(folder), "ndepth" if noisy else "depth"
        images = numbered(folder / "results", prefix, ".png")
        camera, scale = self.camera_of_release, self.depth_scale_of_release
        files, poses = _pair(folder, images, prefix)
        super().__init__(folder, files, poses, camera, scale, INVALID, fps)

    @staticmethod
    def missing(folder: Path) -> list[str]:
        """What keeps a folder from having this layout; empty when it has it."""
        missing = [n for n in ("results", "traj.txt") if not (folder / n).exists()]
        if not (missing or numbered(folder / "results", "ndepth", ".png")):
            missing.append("results/ndepth%06d.png")
        return missing


class ReplicaSequence(ImageSequence):
    """A Replica sequence as distributed with NICE-SLAM (Zhu et al., CVPR 2022).

    Args:
        folder: one sequence, such as room0; cam_params.json is read from it or from the folder above.
        fps: frames a second; 30 by default.

    Raises:
        DatasetError: a file is missing or unreadable.
    """

    layout = "Replica (NICE-SLAM)"

    def __init__(self, folder: str | Path, fps: float | None = None) -> None:
        folder = Path(folder)
        parameters = _camera_file(folder)
        if parameters is None:
            raise DatasetError(f"{folder}: cam_params.json is missing, here and in the folder above")
        camera, scale = _read_camera(parameters)
        files, poses = _pair(folder, numbered(folder / "results", "depth", ".png"), "depth")
        super().__init__(folder, files, poses, camera, scale, INVALID, fps)

    @staticmethod
    def missing(folder: Path) -> list[str]:
        """What keeps a folder from having this layout; empty when it has it."""
        missing = [n for n in ("results", "traj.txt") if not (folder / n).exists()]
        if _camera_file(folder) is None:
            missing.append("cam_params.json (here or in the folder above)")
        return missing


def _pair(
    folder: Path, images: dict[int, Path], prefix: str
) -> tuple[list[Path], Float[np.ndarray, "n 4 4"]]:
    if not images:
        raise DatasetError(f"{folder}: no results/{prefix}%06d.png")
    poses = read_matrices(folder / "traj.txt")
    beyond = [i for i in images if i >= len(poses)]
    if beyond:
        raise DatasetError(
            f"{folder / 'traj.txt'}: {len(poses)} poses, but {images[beyond[0]].name} needs line {beyond[0] + 1}"
        )
    return list(images.values()), poses[list(images)]


def _camera_file(folder: Path) -> Path | None:
    # A relative folder such as "." has no parent to speak of before it is resolved.
    paths = [folder / "cam_params.json", folder.resolve().parent / "cam_params.json"]
    return next((p for p in paths if p.is_file()), None)


def _read_camera(path: Path) -> tuple[PinholeCamera, float]:
    try:
        values = json.loads(path.read_text())["camera"]
        fx, fy, cx, cy, scale = (float(values[n]) for n in ("fx", "fy", "cx", "cy", "scale"))
        camera = PinholeCamera(fx, fy, cx, cy, int(values["w"]), int(values["h"]))
    except KeyError as error:
        raise DatasetError(f"{path}: {error} missing; expected camera: w h fx fy cx cy scale") from error
    except (OSError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"{path}: {error}") from error
    if not scale > 0:
        raise DatasetError(f"{path}: scale must be positive (values a metre), got {scale}")
    return camera, scale
