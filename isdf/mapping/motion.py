"""Whether a depth image was taken where its pose says, or rather where the camera would have been without a jump.

The new image is held against the last one at two poses: the one that came with it, and where the last frames' motion
leads. A pose that has jumped for one frame fits worse there than where the camera really was. True motion, however
fast, fits best at its own pose, and what moves in the scene spoils both alike, so neither is taken for a jump.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.spatial.transform import Rotation

# Depths agree when they differ by less than this [m], plus so much times the squared depth.
TOLERANCE, NOISE = 0.03, 0.012
# Neighbouring pixels whose depths differ by more than this share straddle an edge and tell nothing.
EDGE = 0.05
# A pose closer than this to where the motion leads [m, rad] needs no test.
NEAR, TURNED = 0.06, 0.05
# A camera on a neck sits so far [m] beside the axes that it turns about: it moves by so much times the angle.
LEVER = 0.12
# The share of points in disagreement must exceed that at the other pose by this much, and by this factor.
WORSE, TIMES = 0.05, 2.0
# Least share of the image that both views must show, and least number of points.
OVERLAP, POINTS = 0.1, 100


class Moment(NamedTuple):
    """A frame that was believed.

    Args:
        depth: (h, w) float32 z-depth [m], 0 = unknown.
        intrinsics: fx, fy, cx, cy.
        pose: (4, 4) T_world_camera.
        time: [s].
    """

    depth: Float[np.ndarray, "h w"]
    intrinsics: tuple[float, float, float, float]
    pose: Float[np.ndarray, "4 4"]
    time: float


class Verdict(NamedTuple):
    """What the motion says of a frame's pose.

    Args:
        away: how far [m] from its pose the image fits clearly better; None where its pose is as good as any.
        confirmed: whether the camera is where the motion leads, whichever way it has turned, or the image fits clearly
            better at its pose than there.
    """

    away: float | None
    confirmed: bool


class Motion:
    """Remembers the last two frames that were believed, and judges the pose of the next one by them."""

    def __init__(self) -> None:
        self._last: Moment | None = None
        self._before: Moment | None = None

    def believe(self, moment: Moment) -> None:
        """Go on from this frame."""
        self._before, self._last = self._last, moment

    def judge(self, moment: Moment, stride: int) -> Verdict:
        """Judge the pose of a new frame; every `stride`-th pixel is looked at."""
        if self._last is None:
            return Verdict(None, False)
        expected = self._expected(moment.time)
        moved, turned = apart(expected, moment.pose)
        if moved < NEAR and turned < TURNED:
            return Verdict(None, True)
        steady = moved < NEAR + LEVER * turned
        claimed = self._disagreement(moment, moment.pose, stride)
        other = self._disagreement(moment, expected, stride)
        if claimed is None or other is None:
            return Verdict(None, steady)
        jumped = claimed >= max(TIMES * other, other + WORSE)
        return Verdict(moved if jumped else None, steady or claimed <= other - WORSE)

    def _expected(self, when: float) -> Float[np.ndarray, "4 4"]:
        """The pose that the motion between the last two frames leads to."""
        assert self._last is not None
        last, before = self._last, self._before
        if before is None:
            return last.pose
        elapsed, ahead = last.time - before.time, when - last.time
        part = ahead / elapsed if elapsed > 0 and 0 < ahead < 3 * elapsed else 1.0
        out = last.pose.copy()
        out[:3, 3] += part * (last.pose[:3, 3] - before.pose[:3, 3])
        turn = Rotation.from_matrix(last.pose[:3, :3] @ before.pose[:3, :3].T).as_rotvec()
        out[:3, :3] = Rotation.from_rotvec(part * turn).as_matrix() @ last.pose[:3, :3]
        return out

    def _disagreement(self, moment: Moment, pose: Float[np.ndarray, "4 4"], stride: int) -> float | None:
        """Share of the points that both images show whose depths differ; None where they share too little."""
        assert self._last is not None
        last = self._last
        wrong, shared, valid = differing(
            moment.depth,
            stride,
            moment.intrinsics,
            last.depth,
            last.intrinsics,
            np.linalg.inv(last.pose) @ pose,
        )
        return wrong / shared if shared >= max(POINTS, OVERLAP * valid) else None


def apart(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.arccos(np.clip(cosine, -1, 1)))


@njit(cache=True, nogil=True)
@no_type_check
def differing(depth, stride, intrinsics, other, other_intrinsics, T_other_camera):
    """Count the points of a depth image that another one shows at another depth.

    Args:
        depth: (h, w) float32 [m], 0 = unknown.
        stride: every so many pixels of it is looked at.
        intrinsics: fx, fy, cx, cy.
        other: (h', w') the other depth image.
        other_intrinsics: of it.
        T_other_camera: (4, 4) from the first camera's frame to the other's.

    Returns:
        Points that differ, points that both images show, points of the first image.
    """
    fx, fy, cx, cy = intrinsics
    gx, gy, dx, dy = other_intrinsics
    R, t = T_other_camera[:3, :3], T_other_camera[:3, 3]
    wrong, shared, valid = 0, 0, 0
    for v in range(0, depth.shape[0], stride):
        for u in range(0, depth.shape[1], stride):
            d = depth[v, u]
            if d <= 0:
                continue
            valid += 1
            a, b = (u - cx) / fx * d, (v - cy) / fy * d
            z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * d + t[2]
            if z < 0.05:
                continue
            x = (R[0, 0] * a + R[0, 1] * b + R[0, 2] * d + t[0]) / z * gx + dx
            y = (R[1, 0] * a + R[1, 1] * b + R[1, 2] * d + t[1]) / z * gy + dy
            i, j = int(np.floor(y)), int(np.floor(x))
            if i < 0 or j < 0 or i + 1 >= other.shape[0] or j + 1 >= other.shape[1]:
                continue
            d00, d01, d10, d11 = other[i, j], other[i, j + 1], other[i + 1, j], other[i + 1, j + 1]
            least, most = min(min(d00, d01), min(d10, d11)), max(max(d00, d01), max(d10, d11))
            if least <= 0 or most - least > EDGE * most:
                continue
            p, q = y - i, x - j
            there = (1 - p) * ((1 - q) * d00 + q * d01) + p * ((1 - q) * d10 + q * d11)
            shared += 1
            wrong += abs(there - z) > TOLERANCE + NOISE * z * z
    return wrong, shared, valid
