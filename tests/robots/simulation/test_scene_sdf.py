from __future__ import annotations

import numpy as np
import pytest
import torch

from robots.errors import SceneError
from robots.simulation import Box, Scene, SceneField, Sphere, make_scene
from robots.simulation.poses import planar_pose
from tests.gradients import assert_gradient_matches


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene("apartment", seed=3)


def _in_room(n: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    unit = torch.rand(n, 3, generator=generator, dtype=dtype)
    return unit * torch.tensor([7.6, 5.6, 2.6], dtype=dtype) - torch.tensor([3.8, 2.8, 0.0], dtype=dtype)


def test_distance_is_the_least_over_all_solids(scene):
    points = _in_room(5000)
    each = torch.stack([solid.distance(points) for solid in (*scene.static, *scene.objects)])
    torch.testing.assert_close(SceneField(scene).distance(points), each.amin(dim=0))


def test_inside_is_negative_and_free_space_positive(scene):
    field = SceneField(scene)
    centres = torch.tensor(np.stack([s.pose[:3, 3] for s in (*scene.static, *scene.objects)]))
    assert (field.distance(centres) < 0).all()
    assert field.distance(torch.tensor([*scene.start[:2], 0.5])) >= 0.49


def test_gradient_is_unit_and_agrees_with_finite_differences_and_autograd(scene):
    field = SceneField(scene)
    points = _in_room(30)
    assert_gradient_matches(
        lambda x: field.distance(x).sum(), lambda x: field.distance_and_gradient(x)[1], points
    )
    points = _in_room(3000).requires_grad_()
    (automatic,) = torch.autograd.grad(field.distance(points).sum(), points)
    distance, gradient = field.distance_and_gradient(points)
    assert not gradient.requires_grad and not distance.requires_grad
    torch.testing.assert_close(gradient, automatic)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(3000, dtype=torch.float64))


def test_stepping_down_the_gradient_lands_on_the_surface(scene):
    field = SceneField(scene)
    points = _in_room(2000)
    points = points[field.distance(points) > 0]
    distance, gradient = field.distance_and_gradient(points)
    assert field.distance(points - distance[:, None] * gradient).abs().max() < 1e-9


def test_float32_agrees_with_float64(scene):
    field = SceneField(scene)
    points = _in_room(5000, torch.float32)
    assert field.distance(points).dtype == torch.float32
    difference = field.distance(points).double() - field.distance(points.double())
    assert difference.abs().max() < 5e-6
    with pytest.raises(SceneError, match="float32 or float64"):
        field.distance(points.half())


def test_leaving_out_and_moving_solids():
    floor = Box("floor", planar_pose(0, 0, -0.5), (10.0, 10.0, 1.0))
    ball = Sphere("ball", planar_pose(0, 0, 1), 0.2, mass=1.0)
    field = SceneField(Scene("two", (floor,), (ball,)))
    point = torch.tensor([[0.0, 0.0, 0.5]])
    assert float(field.distance(point)) == pytest.approx(0.3)
    assert float(field.without(["ball"]).distance(point)) == pytest.approx(0.5)
    moved = field.at_poses({"ball": planar_pose(0, 0, 0.6)})
    assert float(moved.distance(point)) == pytest.approx(-0.1)
    assert float(field.distance(point)) == pytest.approx(0.3), "the field itself must not change"
    for call in (lambda: field.without(["bal"]), lambda: field.at_poses({"bal": np.eye(4)})):
        with pytest.raises(SceneError, match=r"'bal'.*'ball', 'floor'"):
            call()
    with pytest.raises(SceneError, match="at least one"):
        field.without(["ball", "floor"])


@pytest.mark.parametrize("shape", [(), (0,), (2, 5), (3, 5000)])
def test_batch_shapes(scene, shape):
    distance, gradient = SceneField(scene).distance_and_gradient(torch.rand(*shape, 3))
    assert distance.shape == shape and gradient.shape == (*shape, 3)
