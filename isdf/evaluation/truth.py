"""Points with their true distances and gradients: what maps are judged by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..errors import EvaluationError

# Half the length of a central difference [m], as in the paper's evaluation, whose truth is a grid of this spacing.
GRADIENT_STEP = 0.01


@dataclass(frozen=True)
class Truth:
    """Evaluation points and what a perfect map would answer there.

    Args:
        points: (n, 3) world points [m].
        distance: (n,) true signed distances [m].
        gradient: (n, 3) true gradients by central differences.

    Raises:
        EvaluationError: a value is NaN or infinite.
    """

    points: Float[Tensor, "n 3"]
    distance: Float[Tensor, "n"]
    gradient: Float[Tensor, "n 3"]

    def __post_init__(self) -> None:
        for name in ("points", "distance", "gradient"):
            wrong = ~torch.isfinite(getattr(self, name))
            if bool(wrong.any()):
                raise EvaluationError(
                    f"{int(wrong.sum())} values of the truth's {name} are NaN or infinite; maps cannot be judged by it"
                )

    @classmethod
    def of(cls, field: Any, points: Float[Tensor, "n 3"]) -> Truth:
        """The answers of an exact distance field."""
        return cls(points, field.distance(points), central_differences(field, points))

    def __len__(self) -> int:
        return len(self.points)

    def where(self, mask: Bool[Tensor, "n"]) -> Truth:
        """The part of it that a mask selects."""
        return Truth(self.points[mask], self.distance[mask], self.gradient[mask])


def central_differences(
    field: Any, points: Float[Tensor, "n 3"], step: float = GRADIENT_STEP
) -> Float[Tensor, "n 3"]:
    """Gradient of any distance field by (f(x + h) - f(x - h)) / 2h along each axis, h = `step` [m]."""
    offsets = step * torch.eye(3, dtype=points.dtype, device=points.device)
    columns = [(field.distance(points + h) - field.distance(points - h)) / (2 * step) for h in offsets]
    return torch.stack(columns, dim=-1)
