"""The moving joints of a robot as plain arrays, for planners that compile their own kinematics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from robots.moving_frames import MovingFrames


class JointChain(NamedTuple):
    """Joint j carries frame j + 1; frame 0 is the root. Parents come before children.

    The pose of frame j + 1 in its parent's is `origin[j]` followed by a turn about, or a slide along, `axis[j]`
    by multiplier[j] * q[column[j]] + offset[j] [rad | m].
    """

    parent: Int[np.ndarray, " joints"]
    origin: Float[np.ndarray, "joints 3 4"]
    axis: Float[np.ndarray, "joints 3"]
    prismatic: Bool[np.ndarray, " joints"]
    column: Int[np.ndarray, " joints"]
    multiplier: Float[np.ndarray, " joints"]
    offset: Float[np.ndarray, " joints"]


def joint_chain(frames: MovingFrames) -> JointChain:
    """The chain of a robot's moving frames."""
    moves = frames.moves
    column, multiplier, offset = zip(*(move.source for move in moves), strict=True)
    return JointChain(
        np.array([move.parent for move in moves], dtype=np.int64),
        np.stack([move.origin[:3] for move in moves]),
        np.stack([move.joint.axis for move in moves]),
        np.array([move.joint.kind == "prismatic" for move in moves]),
        np.array(column, dtype=np.int64),
        np.array(multiplier, dtype=np.float64),
        np.array(offset, dtype=np.float64),
    )
