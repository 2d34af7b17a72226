"""Camera poses from text files, from quaternions, and between time stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from ..errors import DatasetError


def read_numbers(path: Path) -> Float[np.ndarray, "n"]:
    """All numbers of a text file, nan and inf among them; words after # are comments."""
    try:
        lines = path.read_text(errors="replace").splitlines()
        return np.array([w for line in lines for w in line.split("#")[0].split()], dtype=np.float64)
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: missing") from error
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: {error}") from error


def read_table(path: Path, columns: int) -> Float[np.ndarray, "n columns"]:
    """The numbers of a text file in rows of `columns`."""
    numbers = read_numbers(path)
    if len(numbers) == 0 or len(numbers) % columns:
        raise DatasetError(f"{path}: expected rows of {columns} numbers, got {len(numbers)} numbers in all")
    return numbers.reshape(-1, columns)


def read_matrices(path: Path) -> Float[np.ndarray, "n 4 4"]:
    """Row-major 4x4 matrices, one after the other."""
    return read_table(path, 16).reshape(-1, 4, 4)


def read_matrix(path: Path) -> Float[np.ndarray, "4 4"]:
    """The single 4x4 matrix of a text file."""
    matrices = read_matrices(path)
    if len(matrices) != 1:
        raise DatasetError(f"{path}: expected one 4x4 matrix, got {len(matrices)}")
    return matrices[0]


def from_quaternions(
    positions: Float[np.ndarray, "n 3"], quaternions: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n 4 4"]:
    """Rigid transforms from positions [m] and quaternions (x, y, z, w); NaN where one has no direction."""
    poses = np.full((len(positions), 4, 4), np.nan)
    norm = np.linalg.norm(quaternions, axis=1)
    usable = np.isfinite(norm) & (norm > 1e-6) & np.isfinite(positions).all(axis=1)
    quaternions = quaternions / np.where(usable, norm, 1)[:, None]  # the squares of large ones overflow
    poses[usable] = np.eye(4)
    poses[usable, :3, 3] = positions[usable]
    if usable.any():
        poses[usable, :3, :3] = Rotation.from_quat(quaternions[usable]).as_matrix()
    return poses


def poses_at(
    times: Float[np.ndarray, "n"],
    stamps: Float[np.ndarray, "m"],
    poses: Float[np.ndarray, "m 4 4"],
    tolerance: float,
    interpolate: bool = True,
) -> Float[np.ndarray, "n 4 4"]:
    """Poses at other times than they were measured at.

    Args:
        times: when poses are wanted [s].
        stamps: when poses were measured [s], in any order.
        poses: the measured rigid transforms; those that are not finite, or whose time is not, are left out.
        tolerance: the pose is NaN where the nearest measurement is further away than this [s].
        interpolate: linear in position and rotation angle; else the nearest measurement.
    """
    finite = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(stamps)
    stamps, first = np.unique(stamps[finite], return_index=True)
    poses = poses[finite][first]
    out = np.full((len(times), 4, 4), np.nan)
    if len(stamps) == 0 or len(times) == 0:
        return out
    after = np.clip(np.searchsorted(stamps, times), 1, max(len(stamps) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    nearest = np.where(np.abs(stamps[after] - times) < np.abs(times - stamps[before]), after, before)
    if interpolate and len(stamps) > 1:
        inside = np.clip(times, stamps[0], stamps[-1])
        weight = ((inside - stamps[before]) / (stamps[after] - stamps[before]))[:, None]
        out[:] = np.eye(4)
        out[:, :3, 3] = (1 - weight) * poses[before, :3, 3] + weight * poses[after, :3, 3]
        out[:, :3, :3] = Slerp(stamps, Rotation.from_matrix(poses[:, :3, :3]))(inside).as_matrix()
    else:
        out[:] = poses[nearest]
    out[np.abs(stamps[nearest] - times) > tolerance] = np.nan
    return out
