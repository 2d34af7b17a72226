"""Part of a sequence for the mapper, the rest to judge it by."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..camera import PinholeCamera
from ..datasets import DepthSequence
from ..errors import EvaluationError
from ..frames import DepthFrame


class Part:
    """Some frames of a sequence, as a sequence that takes as long as the whole.

    Args:
        whole: the sequence.
        indices: its frames to keep, in order.
    """

    def __init__(self, whole: DepthSequence, indices: Sequence[int]) -> None:
        self.whole, self.indices = whole, list(indices)
        self.folder: Path = whole.folder
        self.camera: PinholeCamera = whole.camera
        self.poses: Float[np.ndarray, "n 4 4"] = whole.poses[self.indices]
        self.fps: float = whole.fps * len(self.indices) / len(whole)

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, i: int) -> DepthFrame:
        """Frame i of the part, with the time it was taken at."""
        return self.whole[self.indices[i]]


def hold_out(sequence: DepthSequence, every: int = 10) -> tuple[Part, Part]:
    """The frames to map, and those held out: one in `every`, the middle one of each such stretch.

    Raises:
        EvaluationError: fewer than two, or more than there are frames.
    """
    if not 2 <= every <= len(sequence):
        raise EvaluationError(
            f"one frame in 2 to {len(sequence)} (the sequence's length) can be held out, got {every}"
        )
    kept = [i for i in range(len(sequence)) if i % every != every // 2]
    held = [i for i in range(len(sequence)) if i % every == every // 2]
    return Part(sequence, kept), Part(sequence, held)
