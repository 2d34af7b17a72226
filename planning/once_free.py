"""Where a base could have driven at some time: what blocks such a place now has come there, and may go again."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


class OnceFree:
    """Cells in plan that were free in some map.

    Args:
        spacing: of the cells [m].
    """

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self._cells = np.empty(0, dtype=np.int64)

    def add(self, positions: Float[Tensor, "n 2"]) -> None:
        """Positions [m] are free now."""
        self._cells = np.union1d(self._cells, self._numbers(positions))

    def were(self, positions: Float[Tensor, "n 2"]) -> Bool[Tensor, "n"]:
        """Which positions [m] were free once."""
        return torch.from_numpy(np.isin(self._numbers(positions), self._cells))

    def _numbers(self, positions: Float[Tensor, "n 2"]) -> np.ndarray:
        x, y = torch.round(positions / self.spacing).long().numpy().T
        return (x << 32) + y
