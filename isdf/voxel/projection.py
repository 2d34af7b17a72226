"""Which pixel each voxel of a box projects onto."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit

from ..camera import PinholeCamera
from ..frames import DepthFrame
from .volume import GrowingVolume

# Voxels closer to the camera than this [m] are not projected.
NEAR = np.float32(0.05)
HALF = np.float32(0.5)


class Projection(NamedTuple):
    """Image coordinates times depth are affine in the voxel index: a sum of one vector an axis.

    Args:
        x: (3, nx) u z, v z and z [m] of the first axis' part, with the constant.
        y: (3, ny) of the second.
        z: (3, nz) of the third.
        begin: (3,) array index of the box's first voxel.
        shape: (3,) of the volume.
        size: (2,) width and height of the image.
    """

    x: Float[np.ndarray, "3 nx"]
    y: Float[np.ndarray, "3 ny"]
    z: Float[np.ndarray, "3 nz"]
    begin: Int[np.ndarray, "3"]
    shape: Int[np.ndarray, "3"]
    size: Int[np.ndarray, "2"]


def projection(frame: DepthFrame, volume: GrowingVolume, begin: np.ndarray, end: np.ndarray) -> Projection:
    """Project the voxels of a box into an image.

    Args:
        frame: its camera and pose.
        volume: whose voxels they are.
        begin: first array index of the box.
        end: one past its last array index.
    """
    camera = frame.camera
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    P = K @ np.linalg.inv(frame.T_world_camera.numpy())[:3]
    along = [
        (P[:, a, None] * (volume.voxel * np.arange(begin[a], end[a]))).astype(np.float32) for a in range(3)
    ]
    along[0] = along[0] + (P[:, :3] @ volume.origin + P[:, 3])[:, None].astype(np.float32)
    size, shape = np.array([camera.width, camera.height]), np.array(volume.shape)
    return Projection(along[0], along[1], along[2], np.asarray(begin), shape, size)


def tiny_frame() -> DepthFrame:
    """A few pixels that see a wall: to compile kernels with before the first real frame."""
    return DepthFrame(torch.ones(4, 4), np.eye(4), PinholeCamera.from_fov(4, 4, 1.0), 0.0)


@njit(cache=True, nogil=True)
@no_type_check
def pixel_of(view, i, j, k):
    """Flat index of the pixel that voxel (i, j, k) of the box projects onto, -1 if none; and its z-depth [m]."""
    z = view.x[2, i] + (view.y[2, j] + view.z[2, k])
    if z <= NEAR:
        return -1, z
    width, height = view.size
    u = view.x[0, i] + (view.y[0, j] + view.z[0, k])
    v = view.x[1, i] + (view.y[1, j] + view.z[1, k])
    right, bottom = (np.float32(width) - HALF) * z, (np.float32(height) - HALF) * z
    if not (-HALF * z < u < right and -HALF * z < v < bottom):
        return -1, z
    column = min(int(u / z + HALF), width - 1)
    row = min(int(v / z + HALF), height - 1)
    return row * width + column, z
