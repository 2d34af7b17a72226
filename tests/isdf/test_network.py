"""The network: embedding directions, sizes, and its hand-derived gradient."""

import pytest
import torch

from isdf import ConfigError, NetworkConfig
from isdf.network import SDFNetwork, _SoftplusPair, icosahedron_directions
from tests.gradients import assert_gradient_matches

SIZES = [NetworkConfig(), NetworkConfig(width=32, hidden_layers=6, skip_layer=4), NetworkConfig(16, 2, 2, 3)]


def make(config: NetworkConfig) -> SDFNetwork:
    network = SDFNetwork(config, torch.tensor([0.3, -0.2, 1.0]), torch.Generator().manual_seed(0))
    for layer in network.layers:  # biases start at zero: give the gradient something to see
        torch.nn.init.normal_(layer.bias, std=0.1, generator=torch.Generator().manual_seed(1))
    return network


def test_directions_are_21_unit_vectors_no_two_parallel() -> None:
    directions = icosahedron_directions()
    assert directions.shape == (21, 3)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(21))
    cosines = (directions @ directions.T).abs() - torch.eye(21)
    assert cosines.max() < 0.86  # neighbours of the tessellation are 31.7 or 36 degrees apart


def test_the_results_variant_has_the_published_number_of_parameters() -> None:
    network = make(NetworkConfig(hidden_layers=6, skip_layer=4))
    assert sum(p.numel() for p in network.parameters()) == 460_033


def test_double_angle_embedding_equals_sines_and_cosines() -> None:
    network = make(NetworkConfig(8))
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) * 4
    embedding, _, _ = network._embed(points)
    scaled = (points - network.origin) * network.config.input_scale
    angles = [2.0**k * scaled @ network.directions.T for k in range(6)]
    expected = torch.cat([scaled, *(a.sin() for a in angles), *(a.cos() for a in angles)], dim=-1)
    torch.testing.assert_close(embedding, expected, atol=2e-5, rtol=0)


@pytest.mark.parametrize("config", SIZES)
def test_gradient_matches_autograd(config: NetworkConfig) -> None:
    network = make(config).double()
    points = torch.randn(40, 3, dtype=torch.float64, requires_grad=True)
    distance, gradient = network.distance_and_gradient(points)
    torch.testing.assert_close(distance, network(points))
    (expected,) = torch.autograd.grad(network(points).sum(), points)
    torch.testing.assert_close(gradient, expected)


@pytest.mark.parametrize("config", SIZES[1:])
def test_gradient_matches_finite_differences(config: NetworkConfig) -> None:
    network = make(config).double()
    points = torch.randn(4, 3, generator=torch.Generator().manual_seed(2))
    assert_gradient_matches(
        lambda x: network(x).sum().detach(), lambda x: network.distance_and_gradient(x)[1].detach(), points
    )


def test_weights_get_the_same_gradients_as_by_double_backward() -> None:
    network = make(NetworkConfig(width=24)).double()
    points = torch.randn(30, 3, dtype=torch.float64, requires_grad=True)

    def weight_gradients(distance, gradient) -> list[torch.Tensor]:
        loss = distance.abs().sum() + (gradient.norm(dim=-1) - 1).abs().sum()
        return list(torch.autograd.grad(loss, list(network.parameters()), allow_unused=True))

    ours = weight_gradients(*network.distance_and_gradient(points))
    # The reference: the same layers with the library's softplus, differentiated twice by autograd.
    embedding, _, _ = network._embed(points)
    hidden = embedding
    for index, layer in enumerate(network._hidden, start=1):
        hidden = torch.cat([hidden, embedding], dim=-1) if index == network.config.skip_layer else hidden
        hidden = torch.nn.functional.softplus(layer(hidden), beta=100.0)
    distance = network.layers[-1](hidden)[:, 0] * network.config.output_scale
    (gradient,) = torch.autograd.grad(distance.sum(), points, create_graph=True)
    for mine, reference in zip(ours, weight_gradients(distance, gradient), strict=True):
        torch.testing.assert_close(mine, reference, rtol=1e-5, atol=1e-7)


def test_softplus_is_exact_and_has_no_denormals() -> None:
    a = torch.linspace(-3, 3, 10_001)
    value, slope = _SoftplusPair.apply(a)
    torch.testing.assert_close(value, torch.nn.functional.softplus(a, beta=100.0), atol=1e-7, rtol=1e-5)
    tiny = torch.finfo(torch.float32).tiny
    assert bool(((slope == 0) | (slope >= tiny)).all())


@pytest.mark.parametrize(
    "bad",
    [{"width": 0}, {"hidden_layers": 1}, {"skip_layer": 1}, {"skip_layer": 5}, {"frequency_octaves": -1}],
)
def test_impossible_sizes_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError, match=r"network needs|skip_layer"):
        NetworkConfig(**bad)
