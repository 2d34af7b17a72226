import pytest
import torch

from planning import CompilableField, PrimitiveField, Solid
from planning.errors import FieldError
from tests.gradients import assert_gradient_matches

SOLIDS = [
    Solid("box", (0.4, 0.6, 0.2), (0.5, 0.0, 0.3), (0.1, 0.2, 0.3, 0.9)),
    Solid("cylinder", (0.5, 0.1), (-0.3, 0.4, 0.2), (0.4, 0.0, 0.1, 0.9)),
    Solid("sphere", (0.2,), (0.0, -0.6, 0.5)),
]


def test_distances_are_those_to_the_nearest_surface():
    field = PrimitiveField(
        [Solid("box", (2.0, 2.0, 2.0), (0, 0, 0)), Solid("cylinder", (2.0, 0.5), (5, 0, 0))]
    )
    points = torch.tensor([[2.0, 0, 0], [2, 2, 0], [0, 0, 0.4], [5, 0.8, 0], [5, 0, 1.7], [5.0, 0.1, 0]])
    expected = torch.tensor([1.0, 2**0.5, -0.6, 0.3, 0.7, -0.4])
    torch.testing.assert_close(field.distance(points), expected)
    assert isinstance(field, CompilableField)
    assert float(PrimitiveField([]).distance(points).min()) > 1e6


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: s.kind)
def test_gradient(solid):
    field = PrimitiveField([solid])
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 2 - 1
    assert_gradient_matches(
        lambda p: field.distance(p).sum(), lambda p: field.distance_and_gradient(p)[1], points, atol=1e-4
    )
    x = points.requires_grad_()
    (gradient,) = torch.autograd.grad(field.distance(x).sum(), x)
    torch.testing.assert_close(gradient, field.distance_and_gradient(points)[1])


@pytest.mark.parametrize(
    "kind, dimensions, position, match",
    [
        ("cone", (1.0, 1.0), (0, 0, 0), "accepted are box"),
        ("box", (1.0, 1.0), (0, 0, 0), "3 positive dimensions"),
        ("cylinder", (1.0, -1.0), (0, 0, 0), "2 positive dimensions"),
        ("sphere", (1.0,), (0, float("nan"), 0), "finite"),
    ],
)
def test_malformed_solids_are_refused(kind, dimensions, position, match):
    with pytest.raises(FieldError, match=match):
        Solid(kind, dimensions, position)
