"""Walking rays through a voxel lattice (Amanatides and Woo, 1987), and the points a depth image's rays end at."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from ..frames import DepthFrame
from .volume import GrowingVolume


class Rays(NamedTuple):
    """Rays of one depth image, in voxels: voxel (i, j, k) of the arrays is the unit cube around (i, j, k).

    Args:
        eye: (3,) where all start.
        ends: (n, 3) where each meets a surface.
        depths: (n,) z-depth of the ends [m].
    """

    eye: Float[np.ndarray, "3"]
    ends: Float[np.ndarray, "n 3"]
    depths: Float[np.ndarray, "n"]


def rays_of(frame: DepthFrame, depth: Float[np.ndarray, "h w"], volume: GrowingVolume) -> Rays:
    """Rays of all pixels whose z-depth [m] is not 0, in the coordinates of a volume that holds them."""
    camera, T = frame.camera, frame.T_world_camera.numpy()
    v, u = np.nonzero(depth > 0)
    z = depth[v, u].astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
    ends = (points @ T[:3, :3].T + T[:3, 3] - volume.origin) / volume.voxel
    return Rays((T[:3, 3] - volume.origin) / volume.voxel, ends, z)


@njit(cache=True, nogil=True)
@no_type_check
def start_walk(start, end, cell, step, ahead, pace):
    """Set up a walk from one point to another; returns how many steps lead to the voxel of the end.

    Args:
        start: (3,) [voxels].
        end: (3,) [voxels].
        cell: (3,) int64, set to the voxel of the start.
        step: (3,) int64, set to the direction along each axis.
        ahead: (3,) set to the share of the way to the next face across each axis.
        pace: (3,) set to the share of the way between two such faces.
    """
    steps = 0
    for a in range(3):
        cell[a] = int(np.floor(start[a] + 0.5))
        way = end[a] - start[a]
        step[a] = 1 if way > 0 else -1
        steps += abs(int(np.floor(end[a] + 0.5)) - cell[a])
        if way == 0:
            ahead[a], pace[a] = np.inf, np.inf
        else:
            pace[a] = 1.0 / abs(way)
            ahead[a] = (cell[a] + 0.5 * step[a] - start[a]) / way
    return steps


@njit(cache=True, nogil=True)
@no_type_check
def advance(cell, step, ahead, pace):
    """Move the walk on to the next voxel."""
    a = 0
    if ahead[1] < ahead[a]:
        a = 1
    if ahead[2] < ahead[a]:
        a = 2
    cell[a] += step[a]
    ahead[a] += pace[a]


@njit(cache=True, nogil=True)
@no_type_check
def flat_index(cell, shape):
    """Flat index of a voxel, -1 outside the volume."""
    for a in range(3):
        if cell[a] < 0 or cell[a] >= shape[a]:
            return -1
    return (cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]
