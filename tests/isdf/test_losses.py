"""The losses' shapes as the paper draws them."""

import pytest
import torch

from isdf import ConfigError, LossConfig
from isdf.losses import eikonal_loss, free_space_loss, gradient_loss, near_surface_loss, total_loss


def test_free_space_loss_is_zero_between_zero_and_the_bound() -> None:
    f, b = torch.linspace(0, 1, 50), torch.ones(50)
    assert bool((free_space_loss(f, b, 5.0) == 0).all())


def test_free_space_loss_is_linear_above_the_bound_and_exponential_below_zero() -> None:
    b = torch.full((3,), 0.5)
    torch.testing.assert_close(
        free_space_loss(torch.tensor([0.6, 1.0, 2.5]), b, 5.0), torch.tensor([0.1, 0.5, 2.0])
    )
    f = torch.tensor([-0.1, -0.5, -0.9])
    torch.testing.assert_close(free_space_loss(f, b, 5.0), torch.exp(-5 * f) - 1)


def test_free_space_loss_stays_finite_and_pulls_back_from_any_prediction() -> None:
    f = torch.tensor([-50.0, -3.0, -1.01, 40.0], requires_grad=True)
    loss = free_space_loss(f, torch.ones(4), 5.0)
    (slope,) = torch.autograd.grad(loss.sum(), f)
    assert torch.isfinite(loss).all()
    assert bool((slope[:3] < 0).all()) and slope[3] > 0


def test_gradient_loss_measures_the_angle_only() -> None:
    g = torch.tensor([[1.0, 0, 0], [0, 2.0, 0], [0, 0, -0.1], [0.3, 0, 0]])
    t = torch.tensor([[5.0, 0, 0], [0.1, 0, 0], [0, 0, 1.0], [0, 0, 0]])
    torch.testing.assert_close(gradient_loss(g, t), torch.tensor([0.0, 1.0, 2.0, 0.0]))


def test_eikonal_loss_wants_unit_length() -> None:
    torch.testing.assert_close(
        eikonal_loss(torch.tensor([[0.0, 0, 0], [0, 1, 0], [3, 0, 4]])), torch.tensor([1.0, 0, 4])
    )


@pytest.mark.parametrize("regions_by", ["ray", "bound"])
def test_total_loss_applies_each_term_in_its_region(regions_by) -> None:
    config = LossConfig(truncation=0.3, regions_by=regions_by)
    measure = torch.tensor([0.05, 0.2, 0.5])
    other = torch.tensor([9.0, 9.0, 9.0])
    ray, bound = (measure, other) if regions_by == "ray" else (other, measure)
    f = torch.tensor([0.1, 0.1, 0.1])
    gradient = torch.tensor([[2.0, 0, 0]] * 3)
    total = total_loss(f, gradient, bound, torch.tensor([[0.0, 1.0, 0.0]] * 3), ray, config)
    near = config.surface_weight * near_surface_loss(f, bound)
    free = free_space_loss(f, bound, config.free_space_beta)
    turn, stretch = config.gradient_weight * 1.0, config.eikonal_weight * 1.0
    expected = torch.stack([near[0] + turn, near[1] + turn + stretch, free[2] + turn + stretch])
    torch.testing.assert_close(total, expected)


def test_a_negative_bound_is_near_the_surface_however_deep() -> None:
    config = LossConfig(regions_by="bound")
    f, gradient = torch.tensor([-0.1]), torch.tensor([[0.0, 0.0, 2.0]])
    total = total_loss(f, gradient, torch.tensor([-0.5]), gradient, torch.tensor([-0.5]), config)
    torch.testing.assert_close(total, config.surface_weight * torch.tensor([0.4]))


def test_the_true_field_has_no_loss() -> None:
    p = torch.rand(100, 3) * 2
    normal = torch.tensor([0.0, 0.0, 1.0]).expand(100, 3)
    loss = total_loss(p[:, 2], normal, p[:, 2], normal, p[:, 2], LossConfig())
    torch.testing.assert_close(loss, torch.zeros(100), atol=1e-6, rtol=0)


def test_negative_weights_are_refused() -> None:
    with pytest.raises(ConfigError, match="eikonal_weight"):
        LossConfig(eikonal_weight=-1.0)
