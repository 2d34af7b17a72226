"""What the best map that guesses nothing would say: exact distances to the surface that a camera has seen."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from ..datasets import DepthSequence
from ..errors import EvaluationError
from .points import FRAME_STRIDE, readable_frames

# Surface points closer together than this are one [m].
SPACING = 0.01


class SeenSurface:
    """Distances to the closest surface point in any noise-free image, negative inside of solids.

    Apart from the spacing of its points, it errs only where the closest surface is one that no image shows. A map errs
    less only where it guesses right.

    Args:
        sequence: noise-free depth images; every `stride`-th is taken.
        truth: exact distance field, asked for the sign alone.
        max_depth: pixels beyond this z-depth show nothing [m].
        stride: of the frames.

    Raises:
        EvaluationError: no frame shows anything.
    """

    def __init__(
        self, sequence: DepthSequence, truth: Any, max_depth: float = 12.0, stride: int = FRAME_STRIDE
    ) -> None:
        found = [
            _apart(frame.thinned(1, max_depth).numpy())
            for frame in readable_frames(sequence, range(0, len(sequence), stride))
        ]
        points = _apart(np.concatenate(found)) if found else np.empty((0, 3))
        if not len(points):
            raise EvaluationError(f"{sequence.folder}: no frame shows a surface within {max_depth} m")
        self._truth, self._surface = truth, KDTree(points)

    def distance(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance [m] at world points [m]."""
        away, _ = self._surface.query(points.detach().cpu().numpy())
        away = torch.from_numpy(away).to(points)
        return torch.where(self._truth.distance(points) < 0, -away, away)


def _apart(points: np.ndarray) -> np.ndarray:
    """One point of each small voxel that has any."""
    x, y, z = np.floor(points / SPACING).astype(np.int64).T
    _, first = np.unique((x << 42) + (y << 21) + z, return_index=True)
    return points[first]
