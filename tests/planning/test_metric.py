import pytest
import torch

from planning import ConfigError, MetricConfig
from planning.limits import project_to_limits
from planning.metric import Metric
from tests.gradients import assert_gradient_matches

CONFIGS = [
    MetricConfig(),
    MetricConfig(0.0, 1.0, 0.0),
    MetricConfig(0.0, 0.0, 1.0),
    MetricConfig(1.0, 0.1, 0.01),
]


@pytest.mark.parametrize("config", CONFIGS)
def test_smoothness_gradient(config):
    metric, q = Metric(9, config), torch.rand(9, 2, dtype=torch.float64)

    def full(interior):
        return torch.cat([q[:1], interior, q[-1:]])

    assert_gradient_matches(
        lambda x: metric.smoothness(full(x))[0], lambda x: metric.smoothness(full(x))[1], q[1:-1], atol=1e-5
    )


@pytest.mark.parametrize("config", CONFIGS)
def test_smoothness_ignores_where_and_grows_with_the_square(config):
    metric, q = Metric(12, config), torch.rand(12, 3, dtype=torch.float64)
    value = float(metric.smoothness(q)[0])
    assert float(metric.smoothness(q + 7.0)[0]) == pytest.approx(value, rel=1e-6)
    assert float(metric.smoothness(3 * q)[0]) == pytest.approx(9 * value, rel=1e-9)
    assert float(metric.smoothness(q.flip(0))[0]) == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize("config", CONFIGS)
def test_a_unit_push_moves_one_unit_at_any_resolution(config):
    for n in (11, 41):
        response = Metric(n, config).solve(torch.eye(n - 2, dtype=torch.float64))
        assert float(response.diagonal().max()) == pytest.approx(1.0, rel=1e-6)
        torch.testing.assert_close(response, response.T, rtol=1e-6, atol=1e-9)


def test_smoothness_of_one_motion_does_not_depend_on_the_number_of_waypoints():
    values = []
    for n in (51, 201):
        t = torch.linspace(0, 1, n, dtype=torch.float64)
        metric = Metric(n, MetricConfig(1.0, 0.0, 0.0))
        values.append(float(metric.smoothness((3.0 * t * t * (1 - t) ** 2)[:, None])[0]))
    assert values[0] == pytest.approx(values[1], rel=2e-2)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_gradient_of_order_d_vanishes_for_polynomials_below_2d(order):
    """d^2k q / dt^2k = 0, away from the ends."""
    weights = [0.0, 0.0, 0.0]
    weights[order - 1] = 1.0
    metric, t = Metric(31, MetricConfig(*weights)), torch.linspace(-1, 1, 31, dtype=torch.float64)
    gradient = metric.smoothness(torch.stack([t ** (2 * order - 1), t ** (2 * order)], dim=1))[1][5:-5]
    assert float(gradient[:, 0].abs().max()) < 1e-6 * float(gradient[:, 1].abs().max())


def test_solve_inverts_the_hessian_of_the_smoothness():
    metric, q = Metric(10, MetricConfig(ridge=0.0)), torch.rand(10, 2, dtype=torch.float64)
    newton = q.clone()
    newton[1:-1] -= metric.solve(metric.smoothness(q)[1])
    torch.testing.assert_close(
        metric.smoothness(newton)[1], torch.zeros(8, 2, dtype=torch.float64), rtol=0, atol=1e-8
    )


def test_too_few_waypoints_and_empty_weights_are_refused():
    with pytest.raises(ConfigError, match="3 waypoints"):
        Metric(2)
    with pytest.raises(ConfigError, match="one must be positive"):
        MetricConfig(0.0, 0.0, 0.0)


def test_projection_keeps_limits_and_leaves_what_is_within():
    metric, limits = Metric(32), torch.tensor([[-0.5, 0.5], [-torch.inf, torch.inf]])
    q = torch.stack([torch.linspace(0, torch.pi, 32).sin(), torch.linspace(0, 9, 32)], dim=1)[1:-1]
    projected = project_to_limits(q, limits, metric)
    assert float(projected[:, 0].max()) <= 0.5
    assert torch.equal(projected[:, 1], q[:, 1])
    # Smooth: no jump larger than the largest one before by more than a little.
    assert float(projected.diff(dim=0)[:, 0].abs().max()) < 1.5 * float(q.diff(dim=0)[:, 0].abs().max())
    assert float(project_to_limits(q, limits, metric, iterations=0)[:, 0].max()) <= 0.5
    inside = 0.4 * q
    assert torch.equal(project_to_limits(inside, limits, metric), inside)
