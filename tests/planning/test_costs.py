import numpy as np
import pytest
import torch

import robots
from planning.compiled.self_collision import grouped
from planning.costs import arc_length_cost, hinge_cost, self_collision_cost
from tests.gradients import assert_gradient_matches


def test_hinge_cost_values_slope_and_continuity():
    eps = 0.2
    at = torch.tensor([-0.1, 0.0, 0.1, 0.2, 0.5])
    cost, slope = hinge_cost(at, eps)
    torch.testing.assert_close(cost, torch.tensor([0.2, 0.1, 0.025, 0.0, 0.0]))
    torch.testing.assert_close(slope, torch.tensor([-1.0, -1.0, -0.5, 0.0, 0.0]))
    d = torch.linspace(-0.15, 0.35, 7)
    assert_gradient_matches(lambda x: hinge_cost(x, eps)[0].sum(), lambda x: hinge_cost(x, eps)[1], d)
    assert hinge_cost(torch.tensor(torch.nan), eps)[0].isnan()


def _bump(x):
    """A smooth cost and its gradient."""
    weight = torch.tensor([1.0, 2.0, -0.5], dtype=x.dtype)
    cost = 1.5 + (x @ weight).sin()
    return cost, (x @ weight).cos().unsqueeze(-1) * weight


def test_arc_length_gradient_is_exact():
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(6, 3, 3, generator=generator, dtype=torch.float64)
    assert_gradient_matches(
        lambda p: arc_length_cost(p, *_bump(p))[0], lambda p: arc_length_cost(p, *_bump(p))[1], x
    )


def test_arc_length_gradient_is_finite_and_exact_at_rest():
    x = torch.full((4, 2, 3), 0.3, dtype=torch.float64)
    value, gradient = arc_length_cost(x, *_bump(x))
    assert value > 0 and gradient.isfinite().all()
    assert_gradient_matches(
        lambda p: arc_length_cost(p, *_bump(p))[0], lambda p: arc_length_cost(p, *_bump(p))[1], x, step=1e-6
    )


def test_arc_length_cost_does_not_depend_on_the_speed():
    """The same path at another parametrisation has the same cost."""
    t = torch.linspace(0, 1, 4000, dtype=torch.float64)

    def cost(s):
        x = torch.stack([s, (3 * s).sin(), s**2], dim=-1)[:, None]
        return float(arc_length_cost(x, *_bump(x), guard=0.0)[0])

    assert cost(t) == pytest.approx(cost(t**3), rel=1e-5)


def test_arc_length_gradient_tends_to_the_functional_gradient_of_the_paper():
    """|x'| [(I - x' x'^T) grad c - c kappa], per unit of time."""
    errors = []
    for n in (51, 101, 201):
        t = torch.linspace(0, 1, n, dtype=torch.float64)
        x = torch.stack([t, (3 * t).sin(), t**2], dim=-1)
        first = torch.stack([torch.ones_like(t), 3 * (3 * t).cos(), 2 * t], dim=-1)
        second = torch.stack([torch.zeros_like(t), -9 * (3 * t).sin(), torch.full_like(t, 2.0)], dim=-1)
        cost, gradient = _bump(x)
        speed = first.norm(dim=-1, keepdim=True)
        unit = first / speed

        def across(v, unit=unit):
            return v - (v * unit).sum(-1, keepdim=True) * unit

        kappa = across(second) / speed**2
        expected = speed * (across(gradient) - cost[:, None] * kappa)
        _, discrete = arc_length_cost(x[:, None], cost[:, None], gradient[:, None], guard=0.0)
        errors.append(float((discrete[1:-1, 0] * (n - 1) - expected[1:-1]).abs().max()))
    assert errors[0] < 0.2
    assert errors[1] < errors[0] / 3 and errors[2] < errors[1] / 3


def test_self_collision_gradient_and_gap():
    generator = torch.Generator().manual_seed(1)
    x = 0.3 * torch.rand(3, 5, 3, generator=generator, dtype=torch.float64)
    radii = torch.full((5,), 0.05, dtype=torch.float64)
    pairs = np.array([[0, 2], [0, 3], [1, 4]])
    groups = grouped(pairs, None, x[0].numpy(), radii.numpy())
    cost, _, gap = self_collision_cost(x, radii, groups, 0.2)
    assert cost > 0
    expected = min(float((x[1, i] - x[1, j]).norm()) - 0.1 for i, j in pairs.tolist())
    assert float(gap[1]) == pytest.approx(expected)
    assert_gradient_matches(
        lambda p: self_collision_cost(p, radii, groups, 0.2)[0],
        lambda p: self_collision_cost(p, radii, groups, 0.2)[1],
        x,
    )


def test_coinciding_spheres_have_a_finite_gradient():
    x, radii = torch.zeros(1, 2, 3), torch.full((2,), 0.1)
    groups = grouped(np.array([[0, 1]]), None, x[0].numpy(), radii.numpy())
    cost, gradient, gap = self_collision_cost(x, radii, groups, 0.05)
    assert gradient.isfinite().all() and cost.isfinite() and float(gap) == pytest.approx(-0.2)


def test_groups_of_links_change_nothing_but_the_time():
    robot = robots.load("panda")
    low, high = robot.joint_limits.double().unbind(1)
    q = low + (high - low) * torch.rand(
        60, robot.num_dofs, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    centres, radii = robot.spheres(q)
    known, links = robot.self_collision_pairs.numpy(), robot.sphere_links
    alone, by_link = (
        grouped(known, names, centres[7].double().numpy(), radii.double().numpy()) for names in (None, links)
    )
    assert len(by_link.reach) < len(alone.reach) / 100
    x = centres.double().unsqueeze(1)
    one, other = (self_collision_cost(x, radii.double(), groups, 0.03) for groups in (alone, by_link))
    assert (one[0] > 0).sum() > 10
    for a, b in zip(one, other, strict=True):
        torch.testing.assert_close(a, b)
