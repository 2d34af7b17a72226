from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from robots.errors import SceneError
from robots.simulation import Box, Cylinder, Sphere
from tests.gradients import assert_gradient_matches


def _tilted() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
    pose[:3, 3] = [0.3, -0.2, 0.5]
    return pose


SOLIDS = (
    Box("box", _tilted(), (0.6, 0.4, 1.0)),
    Cylinder("cylinder", _tilted(), 0.3, 0.8),
    Sphere("sphere", _tilted(), 0.4),
)


def _points(n: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(n, 3, generator=generator, dtype=dtype) - 0.5) * 2.5 + torch.tensor([0.3, -0.2, 0.5])


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: s.name)
def test_distance_is_that_to_its_mesh(solid):
    points = _points(400)
    expected = -trimesh.proximity.signed_distance(solid.mesh(), points.numpy())
    # A faceted round surface lies up to half a millimetre inside the true one.
    np.testing.assert_allclose(
        solid.distance(points).numpy(), expected, atol=1e-9 if solid.kind == "box" else 1e-3
    )


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: s.name)
def test_gradient_matches_finite_differences_and_has_unit_length(solid):
    points = _points(60, seed=1)
    distance, gradient = solid.distance_and_gradient(points)
    assert (distance < 0).any() and (distance > 0).any()
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(60, dtype=torch.float64))
    assert_gradient_matches(
        lambda x: solid.distance(x).sum(), lambda x: solid.distance_and_gradient(x)[1], points
    )


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: s.name)
def test_autograd_gives_the_closed_form_gradient(solid):
    points = _points(200, seed=2).requires_grad_()
    (gradient,) = torch.autograd.grad(solid.distance(points).sum(), points)
    torch.testing.assert_close(gradient, solid.distance_and_gradient(points.detach())[1])


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: s.name)
def test_centre_edges_and_far_away_stay_finite(solid):
    centre = torch.tensor(solid.pose[:3, 3])
    special = torch.stack((centre, centre + 1e6, torch.tensor(solid.mesh().vertices[0])))
    distance, gradient = solid.distance_and_gradient(special)
    assert distance.isfinite().all() and gradient.isfinite().all()
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(3, dtype=torch.float64))
    assert distance[0] < 0 and abs(distance[2]) < 1e-9


@pytest.mark.parametrize("shape", [(), (3,), (2, 0), (2, 4, 5)])
def test_batch_shape_and_dtype_are_kept(shape):
    points = torch.randn(*shape, 3)
    distance, gradient = SOLIDS[1].distance_and_gradient(points)
    assert distance.shape == shape and gradient.shape == (*shape, 3) and gradient.dtype == torch.float32


def test_moving_a_solid_and_the_points_alike_changes_nothing():
    move, points = _tilted(), _points(50)
    solid = SOLIDS[0]
    moved = points @ torch.tensor(move[:3, :3]).T + torch.tensor(move[:3, 3])
    torch.testing.assert_close(solid.at(move @ solid.pose).distance(moved), solid.distance(points))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Box("b", np.eye(4), (1.0, 0.0, 1.0)),
        lambda: Sphere("b", np.eye(4), -1.0),
        lambda: Sphere("b", 2 * np.eye(4), 1.0),
        lambda: Sphere("b", np.eye(3), 1.0),
        lambda: Sphere("b", np.eye(4), 1.0, mass=-0.1),
    ],
)
def test_impossible_solids_are_refused_by_name(make):
    with pytest.raises(SceneError, match=r"^b: "):
        make()
