"""Surface points between the voxels of a TSDF."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .tsdf import TsdfVolume


class Seeds(NamedTuple):
    """Surface points, at most one a voxel.

    Args:
        voxel: flat indices of the voxels that hold them.
        position: in array coordinates: voxels from the centre of voxel (0, 0, 0).
        normal: unit vectors out of the surface, towards where it was seen from.
    """

    voxel: Int[np.ndarray, "n"]
    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]


def surface_seeds(volume: TsdfVolume) -> Seeds:
    """Zero crossings between observed neighbours by linear interpolation, averaged within each voxel."""
    shape, observed = volume.shape, volume.weight > 0
    values = np.where(observed, volume.distance, np.float32(np.nan))
    crossings = [_crossings(values, axis) for axis in range(3)]
    points = np.concatenate(crossings)
    holder = np.ravel_multi_index(np.rint(points).astype(int).T, shape) if len(points) else np.zeros(0, int)
    voxel, member, count = np.unique(holder, return_inverse=True, return_counts=True)
    sums = [np.bincount(member, weights=points[:, i], minlength=len(voxel)) for i in range(3)]
    position = (np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]).astype(np.float32)
    return Seeds(voxel, position, _normals(values, voxel))


def _crossings(values: Float[np.ndarray, "nx ny nz"], axis: int) -> Float[np.ndarray, "n 3"]:
    """Array coordinates of the zeros along one axis; NaN is unobserved."""
    before = [slice(None)] * 3
    after = [slice(None)] * 3
    before[axis], after[axis] = slice(None, -1), slice(1, None)
    a, b = values[tuple(before)], values[tuple(after)]
    at = np.nonzero(((a < 0) & (b >= 0)) | ((a >= 0) & (b < 0)))
    points = np.stack(at, axis=1).astype(np.float32)
    points[:, axis] += a[at] / (a[at] - b[at])
    return points


def _normals(values: Float[np.ndarray, "nx ny nz"], voxel: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    """Directions of steepest increase at the given voxels, from whichever neighbours were observed."""
    place = np.stack(np.unravel_index(voxel, values.shape), axis=1)
    here = values.reshape(-1)[voxel]
    slope = np.zeros((len(voxel), 3), dtype=np.float32)
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        ahead = values[tuple(np.minimum(place + step, np.array(values.shape) - 1).T)]
        behind = values[tuple(np.maximum(place - step, 0).T)]
        sides = np.stack([ahead - here, here - behind])
        known = np.isfinite(sides)
        slope[:, axis] = np.where(known, sides, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    return np.where(length > 0, slope / np.maximum(length, 1e-12), np.float32(np.sqrt(1 / 3)))
