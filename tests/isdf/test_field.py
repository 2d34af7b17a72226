"""Fields: the neural snapshot, the baked grid, and the cost over either."""

import numpy as np
import pytest
import torch

from isdf import ConfigError, CostField, GridField, IsdfError, NetworkConfig, NeuralField, bake, query
from isdf.cost import collision_cost
from isdf.field import check_points
from isdf.meshing import zero_level_mesh
from isdf.network import SDFNetwork
from tests.gradients import assert_gradient_matches
from tests.isdf.rooms import ball


class BallField:
    """A ball, as anybody's distance field."""

    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    distance = staticmethod(ball((0.1, 0.0, 0.0), 0.5))

    def distance_and_gradient(self, points):
        offset = points - torch.tensor([0.1, 0.0, 0.0]).to(points)
        return self.distance(points), offset / offset.norm(dim=-1, keepdim=True)


def neural(dtype=torch.float32) -> NeuralField:
    network = SDFNetwork(NetworkConfig(width=16), torch.zeros(3), torch.Generator().manual_seed(0)).to(dtype)
    return NeuralField(network, BallField.bounds)


def grid() -> GridField:
    return bake(BallField(), BallField.bounds, 0.1, padding=0.3)


FIELDS = {"neural": neural, "grid": grid}


@pytest.mark.parametrize("make", FIELDS.values(), ids=FIELDS)
@pytest.mark.parametrize("shape", [(3,), (7, 3), (2, 5, 3), (0, 3)])
def test_any_batch_shape(make, shape) -> None:
    distance, gradient = make().distance_and_gradient(torch.rand(shape))
    assert distance.shape == shape[:-1] and gradient.shape == shape
    assert make().distance(torch.rand(shape)).shape == shape[:-1]


@pytest.mark.parametrize("make", FIELDS.values(), ids=FIELDS)
def test_autograd_gives_the_fast_path_gradient(make) -> None:
    field, points = make(), torch.rand(20, 3, requires_grad=True)
    (through_graph,) = torch.autograd.grad((3 * field.distance(points)).sum(), points)
    torch.testing.assert_close(through_graph, 3 * field.distance_and_gradient(points)[1])


def test_gradients_match_finite_differences() -> None:
    points = torch.rand(6, 3, generator=torch.Generator().manual_seed(3)) * 1.4 - 0.7
    for field in (neural(torch.float64), _double_grid()):
        assert_gradient_matches(
            lambda x, f=field: f.distance(x).sum(),
            lambda x, f=field: f.distance_and_gradient(x)[1],
            points,
            step=1e-6,
        )


def _double_grid() -> GridField:
    coarse = grid()
    return GridField(coarse.values.double(), coarse.origin.double(), coarse.spacing)


def test_more_points_than_a_block_are_answered_as_one_by_one() -> None:
    field, points = neural(), torch.rand(9000, 3)
    distance, gradient = field.distance_and_gradient(points)
    d, g = field.distance_and_gradient(points[8999])
    torch.testing.assert_close(distance[8999], d, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(gradient[8999], g, atol=1e-5, rtol=1e-4)


def test_a_snapshot_does_not_change_when_the_network_does() -> None:
    network = SDFNetwork(NetworkConfig(width=16), torch.zeros(3))
    field, points = NeuralField(network, BallField.bounds), torch.rand(10, 3)
    before = field.distance(points)
    with torch.no_grad():
        network.layers[-1].bias += 1.0
    torch.testing.assert_close(field.distance(points), before)


def test_baking_is_exact_at_grid_points_and_close_between() -> None:
    field = grid()
    at = field.origin + 0.1 * torch.tensor([3.0, 7.0, 11.0])
    torch.testing.assert_close(field.distance(at), BallField.distance(at), atol=1e-5, rtol=0)
    points = torch.rand(2000, 3) * 2 - 1
    off_centre = BallField.distance(points) > -0.3
    error = (field.distance(points) - BallField.distance(points)).abs()[off_centre]
    curvature = 2 / 0.2  # [1/m] the sum of the second derivatives where it is greatest, 20 cm from the centre
    assert error.max() < 1.05 * 0.1**2 / 8 * curvature
    fine = bake(BallField(), BallField.bounds, 0.05, padding=0.3)
    assert (fine.distance(points) - BallField.distance(points)).abs()[off_centre].max() < 0.5 * error.max()


def test_outside_the_grid_the_boundary_value_holds_and_the_gradient_across_is_zero() -> None:
    field = grid()
    far, edge = torch.tensor([9.0, 0.0, 0.0]), torch.tensor([float(field.bounds[1, 0]), 0.0, 0.0])
    torch.testing.assert_close(field.distance(far), field.distance(edge))
    assert field.distance_and_gradient(far)[1][0] == 0


def test_the_cost_is_the_papers() -> None:
    eps = 2.0
    s = torch.tensor([-0.5, 0.0, 1.0, 2.0, 3.0])
    cost, slope = collision_cost(s, eps)
    torch.testing.assert_close(cost, torch.tensor([1.5, 1.0, 0.25, 0.0, 0.0]))
    torch.testing.assert_close(slope, torch.tensor([-1.0, -1.0, -0.5, 0.0, 0.0]))


def test_cost_and_its_slope_are_continuous() -> None:
    for edge in (0.0, 0.4):
        around = torch.tensor([edge - 1e-6, edge + 1e-6], dtype=torch.float64)
        cost, slope = collision_cost(around, 0.4)
        assert abs(float(cost[1] - cost[0])) < 1e-5 and abs(float(slope[1] - slope[0])) < 1e-4


@pytest.mark.parametrize(
    "make", [BallField, lambda: neural(torch.float64), _double_grid], ids=["ball", "neural", "grid"]
)
def test_cost_gradient_matches_finite_differences_and_autograd(make) -> None:
    cost = CostField(make(), eps=0.5)
    points = torch.rand(6, 3, generator=torch.Generator().manual_seed(5)).double() * 1.4 - 0.7
    radii = torch.linspace(0.02, 0.2, 6).double()
    assert_gradient_matches(
        lambda x: cost.cost(x, radii).sum(), lambda x: cost.cost_and_gradient(x, radii)[1], points, step=1e-6
    )
    points = points.requires_grad_(True)
    (through_graph,) = torch.autograd.grad(cost.cost(points, radii).sum(), points)
    torch.testing.assert_close(through_graph, cost.cost_and_gradient(points.detach(), radii)[1])


def test_numpy_in_numpy_out() -> None:
    answer = query(grid(), np.random.default_rng(0).uniform(-1, 1, (50, 3)))
    assert answer["distance"].shape == (50,) and answer["gradient"].shape == (50, 3)
    assert set(answer) == {"distance", "gradient"}
    for bad in (np.zeros((5, 2)), np.zeros(3), np.array([["a", "b", "c"]])):
        with pytest.raises(IsdfError, match=r"\(n, 3\)"):
            query(grid(), bad)


def test_wrong_points_and_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match="eps must be a positive"):
        CostField(grid(), 0.0)
    with pytest.raises(ConfigError, match="spacing > 0"):
        bake(BallField(), BallField.bounds, -0.1)
    with pytest.raises(ConfigError, match="lower < upper"):
        bake(BallField(), BallField.bounds.flip(0), 0.1)
    with pytest.raises(ConfigError, match="at least 2 points"):
        GridField(torch.zeros(1, 4, 4), torch.zeros(3), 0.1)
    with pytest.raises(IsdfError, match="floating point"):
        check_points(torch.zeros(4, 2))


def test_a_balls_mesh_has_its_volume_and_faces_outward() -> None:
    class Ball:
        bounds = torch.tensor([[-0.6, -0.6, -0.6], [0.6, 0.6, 0.6]])

        def distance(self, points: torch.Tensor) -> torch.Tensor:
            return points.norm(dim=-1) - 0.5

    mesh = zero_level_mesh(Ball(), 0.03)
    assert mesh.volume == pytest.approx(4 / 3 * torch.pi * 0.5**3, rel=0.01)
    upward = mesh.vertices[:, 2] > 0.45
    assert (
        mesh.visual.vertex_colors[upward, 0].min()
        > mesh.visual.vertex_colors[mesh.vertices[:, 2] < -0.45, 0].max()
    )


def test_a_baked_field_is_as_confident_as_the_one_it_was_baked_from():
    class Half:
        def distance(self, points: torch.Tensor) -> torch.Tensor:
            return points[..., 2]

        def confidence(self, points: torch.Tensor) -> torch.Tensor:
            return (points[..., 0] > 0).to(points)

    bounds = torch.tensor([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    baked = bake(Half(), bounds, 0.1)
    at = torch.tensor([[0.5, 0.0, 0.5], [-0.5, 0.0, 0.5], [0.5, 0.0, 9.0]])
    assert baked.confidence(at).tolist() == [1, 0, 0]
    assert baked.confidence(at.view(3, 1, 3)).shape == (3, 1)
    again = bake(baked, bounds, 0.1)
    torch.testing.assert_close(again.confidence(at), baked.confidence(at))
    assert not hasattr(bake(GridField(torch.rand(4, 4, 4), torch.zeros(3), 0.1), bounds, 0.5), "confidence")
