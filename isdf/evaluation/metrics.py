"""The paper's three errors, in bins of the true distance, with the share of unsafe answers (paper section 5.3)."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from scipy.stats import rankdata
from torch import Tensor

from ..cost import collision_cost
from ..errors import EvaluationError
from .truth import Truth, central_differences

# Edges of the bins of the true distance [m].
BINS = (-math.inf, 0.0, 0.1, 0.2, 0.5, 1.0, math.inf)
# Reach of the collision cost in the paper's evaluation [m].
COST_EPS = 2.0
# A distance more than this above the true one is unsafe to plan with [m].
UNSAFE = 0.05

GradientMethod = Literal["central", "own"]


@dataclass(frozen=True)
class Scores:
    """Means over the evaluation points; None where there are no points.

    Args:
        points: how many.
        sdf_error: |f - s| [m].
        cost_error: |c(f) - c(s)| [m], c the CHOMP cost with a reach of 2 m.
        gradient_distance: 1 - cosine of the angle between the gradients; 1 where the map's gradient is zero.
        overestimated: share of points where f is more than 5 cm above s.
        bias: f - s [m].
        bins: the same for the points of each interval of the true distance, lower edge included.
    """

    points: int
    sdf_error: float | None
    cost_error: float | None
    gradient_distance: float | None
    overestimated: float | None
    bias: float | None
    bins: tuple[Scores, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Plain values, to be written to a file."""
        return dataclasses.asdict(self)


def evaluate(
    field: Any,
    truth: Truth,
    gradient: GradientMethod = "central",
    unmapped: Bool[Tensor, "n"] | None = None,
) -> Scores:
    """Judge a distance field.

    Args:
        field: any distance field.
        truth: points and what is true there.
        gradient: "central" takes the field's gradient by the same differences of 1 cm as the truth's, as the paper
            does; "own" asks the field for it, as a planner does.
        unmapped: points that the map does not claim to know. There the collision cost is taken as that of a surface,
            c(0), since a robot would keep away (paper, figure of the main results).

    Raises:
        EvaluationError: an answer is NaN or infinite: none is ever left out of a mean.
    """
    if gradient == "own":
        predicted, slope = field.distance_and_gradient(truth.points)
    else:
        predicted, slope = field.distance(truth.points), central_differences(field, truth.points)
    _check(predicted, slope, truth.points)
    cost = collision_cost(predicted, COST_EPS)[0]
    if unmapped is not None:
        cost = torch.where(unmapped, collision_cost(torch.zeros(()), COST_EPS)[0], cost)
    error = predicted - truth.distance
    table = torch.stack(
        [
            error.abs(),
            (cost - collision_cost(truth.distance, COST_EPS)[0]).abs(),
            1 - torch.cosine_similarity(slope, truth.gradient, dim=-1),
            (error > UNSAFE).float(),
            error,
        ],
        dim=1,
    ).double()
    inner = torch.bucketize(truth.distance, torch.tensor(BINS[1:-1], dtype=truth.distance.dtype), right=True)
    bins = tuple(_means(table[inner == i]) for i in range(len(BINS) - 1))
    return dataclasses.replace(_means(table), bins=bins)


def roc_area(
    confidence: Float[Tensor, "n"], error: Float[Tensor, "n"], threshold: float = UNSAFE
) -> float | None:
    """How well low confidence tells large errors: area under the ROC curve of 1 - confidence.

    That is the chance that a point whose |error| exceeds `threshold` [m] is trusted less than one whose does not:
    1 is perfect, 0.5 is no better than chance. None where all points or none are in error.

    Raises:
        EvaluationError: a value is NaN.
    """
    if bool(confidence.isnan().any()) or bool(error.isnan().any()):
        raise EvaluationError("confidence or error is NaN somewhere; all points must be judged")
    wrong = error.abs() > threshold
    bad, good = int(wrong.sum()), int((~wrong).sum())
    if bad == 0 or good == 0:
        return None
    rank = torch.from_numpy(rankdata(-confidence.double().numpy()))
    return float((rank[wrong].sum() - bad * (bad + 1) / 2) / (bad * good))


def _means(table: Float[Tensor, "n 5"]) -> Scores:
    if len(table) == 0:
        return Scores(0, None, None, None, None, None)
    return Scores(len(table), *table.mean(dim=0).tolist())


def _check(predicted: Tensor, slope: Tensor, points: Tensor) -> None:
    for name, values in (("distance", predicted[:, None]), ("gradient", slope)):
        wrong = ~torch.isfinite(values).all(dim=-1)
        if bool(wrong.any()):
            at = [round(float(x), 3) for x in points[wrong][0]]
            raise EvaluationError(
                f"the field's {name} is NaN or infinite at {int(wrong.sum())} of {len(points)} points, first at {at}; "
                "a map must answer everywhere: give it a guess there and say so by its confidence"
            )
