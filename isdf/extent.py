"""The box that encloses what a map has seen."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .frames import DepthFrame

# Share of a frame's surface points left out at either end of every axis: stray measurements lie far out.
OUTLIERS = 0.005
# Pixels across that are looked at; more tell nothing new about the box.
COLUMNS = 80


def nothing_seen() -> Float[Tensor, "2 3"]:
    """The box that grows to any other."""
    return torch.tensor([[torch.inf] * 3, [-torch.inf] * 3])


def grown(bounds: Float[Tensor, "2 3"], frame: DepthFrame, max_depth: float) -> Float[Tensor, "2 3"]:
    """Lower and upper corner [m], on the CPU, extended by a frame's surfaces (but for outliers) and its camera."""
    corners = frame.T_world_camera[None, :3, 3].float().cpu()
    points = frame.thinned(max(1, frame.camera.width // COLUMNS), max_depth).cpu()
    if len(points):
        corners = torch.cat([corners, torch.quantile(points, torch.tensor([OUTLIERS, 1 - OUTLIERS]), dim=0)])
    low, high = torch.minimum(bounds[0], corners.amin(dim=0)), torch.maximum(bounds[1], corners.amax(dim=0))
    return torch.stack([low, high])


def fits(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], most: int) -> bool:
    """Whether a box between lattice indices, as floats, has at most so many entries and its indices are integers.

    Numbers too large for an integer become small ones when they are converted, so this is asked before.
    """
    return bool(np.prod(high - low) <= most and np.abs([low, high]).max() < 2.0**40)
