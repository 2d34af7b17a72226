"""Forward kinematics of a chain of joints, and the pull of forces on its spheres back to the joints."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from planning.compiled.arrays import Chain


@njit(cache=True, nogil=True)
@no_type_check
def poses(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Poses (frames, 3, 4) of all frames in the root's at a configuration q (dof,)."""
    out = np.empty((len(chain.parent) + 1, 3, 4))
    out[0] = np.eye(3, 4)
    local = np.empty((3, 4))
    for j in range(len(chain.parent)):
        value = chain.multiplier[j] * q[chain.column[j]] + chain.offset[j]
        _moved(chain, j, value, local)
        p = chain.parent[j]
        for r in range(3):
            for c in range(4):
                out[j + 1, r, c] = (
                    out[p, r, 0] * local[0, c] + out[p, r, 1] * local[1, c] + out[p, r, 2] * local[2, c]
                )
            out[j + 1, r, 3] += out[p, r, 3]
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _moved(chain: Chain, j: int, value: float, out: np.ndarray) -> None:
    """A joint's origin followed by its motion: a slide, or a turn by Rodrigues' formula."""
    origin = chain.origin
    x, y, z = chain.axis[j, 0], chain.axis[j, 1], chain.axis[j, 2]
    if chain.prismatic[j]:
        for r in range(3):
            for k in range(4):
                out[r, k] = origin[j, r, k]
            out[r, 3] += value * (origin[j, r, 0] * x + origin[j, r, 1] * y + origin[j, r, 2] * z)
        return
    s, c = math.sin(value), math.cos(value)
    t = 1.0 - c
    for r in range(3):
        a, b, d = origin[j, r, 0], origin[j, r, 1], origin[j, r, 2]
        out[r, 0] = a * (t * x * x + c) + b * (t * x * y + s * z) + d * (t * x * z - s * y)
        out[r, 1] = a * (t * x * y - s * z) + b * (t * y * y + c) + d * (t * y * z + s * x)
        out[r, 2] = a * (t * x * z + s * y) + b * (t * y * z - s * x) + d * (t * z * z + c)
        out[r, 3] = origin[j, r, 3]


@njit(cache=True, nogil=True)
@no_type_check
def place(frames: np.ndarray, frame: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """World positions (s, 3) of points given in frames."""
    out = np.empty_like(centres)
    for i in range(len(frame)):
        pose = frames[frame[i]]
        x, y, z = centres[i]
        for r in range(3):
            out[i, r] = pose[r, 0] * x + pose[r, 1] * y + pose[r, 2] * z + pose[r, 3]
    return out


@njit(cache=True, nogil=True)
@no_type_check
def sphere_centres(chain: Chain, frame: np.ndarray, centres: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Centres (n, s, 3) of spheres at states (n, dof)."""
    out = np.empty((len(states), len(frame), 3))
    for i in range(len(states)):
        out[i] = place(poses(chain, states[i]), frame, centres)
    return out


@njit(cache=True, nogil=True)
@no_type_check
def pull_back(
    chain: Chain, frame: np.ndarray, states: np.ndarray, points: np.ndarray, forces: np.ndarray
) -> np.ndarray:
    """J^T f: gradient (n, dof) by the joints, given that (n, s, 3) by the sphere centres `points` (n, s, 3).

    Forces are summed from the tips to the root: a joint feels the force and the torque of all it carries.
    """
    n, joints = len(states), len(chain.parent)
    out = np.zeros(states.shape)
    for i in range(n):
        frames = poses(chain, states[i])
        force = np.zeros((joints + 1, 3))
        torque = np.zeros((joints + 1, 3))  # about the world's origin
        for s in range(len(frame)):
            f, x = forces[i, s], points[i, s]
            if f[0] == 0.0 and f[1] == 0.0 and f[2] == 0.0:
                continue
            k = frame[s]
            for r in range(3):
                force[k, r] += f[r]
            torque[k, 0] += x[1] * f[2] - x[2] * f[1]
            torque[k, 1] += x[2] * f[0] - x[0] * f[2]
            torque[k, 2] += x[0] * f[1] - x[1] * f[0]
        for j in range(joints - 1, -1, -1):
            pose, f, t = frames[j + 1], force[j + 1], torque[j + 1]
            ax, ay, az = chain.axis[j]
            x = pose[0, 0] * ax + pose[0, 1] * ay + pose[0, 2] * az
            y = pose[1, 0] * ax + pose[1, 1] * ay + pose[1, 2] * az
            z = pose[2, 0] * ax + pose[2, 1] * ay + pose[2, 2] * az
            if chain.prismatic[j]:
                felt = x * f[0] + y * f[1] + z * f[2]
            else:
                px, py, pz = pose[0, 3], pose[1, 3], pose[2, 3]
                felt = (
                    x * (t[0] - (py * f[2] - pz * f[1]))
                    + y * (t[1] - (pz * f[0] - px * f[2]))
                    + z * (t[2] - (px * f[1] - py * f[0]))
                )
            out[i, chain.column[j]] += chain.multiplier[j] * felt
            above = chain.parent[j]
            for r in range(3):
                force[above, r] += f[r]
                torque[above, r] += t[r]
    return out
