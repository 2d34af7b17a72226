import pytest
import torch

from planning import MetricConfig, ObjectiveConfig, WorkspaceConfig
from planning.metric import Metric
from planning.objective import Objective
from planning.workspace import Workspace
from tests.gradients import assert_gradient_matches
from tests.planning.fields import Box, Confident, Cylinder, HalfSpace, HingeCost, Room, Sphere, Union
from tests.planning.robots import Base, Disc, PlanarArm

ARM_SCENE = Union(Sphere((0.7, 0.3, 0.5), 0.2), Box((0.1, 0.9, 0.5), (0.2, 0.1, 0.3)))
BASE_SCENE = Union(HalfSpace(), Cylinder((0.5, 0.1), 0.2), Room(Box((0.5, 0.0, 1.0), (2.0, 0.7, 1.0))))


def _objective(robot, sdf, n, substeps=1, eps=0.3, **workspace):
    config = ObjectiveConfig(smoothness_weight=0.2, self_collision_eps=0.2)
    space = Workspace(robot, sdf, eps, WorkspaceConfig(**workspace))
    return Objective(robot, space, Metric(n, MetricConfig()), config, substeps)


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize(
    "robot, sdf",
    [
        (PlanarArm((0.4, 0.4, 0.3), per_link=3), ARM_SCENE),
        (PlanarArm((0.5, 0.5), per_link=3), HingeCost(ARM_SCENE, 0.3)),
        (Base(), BASE_SCENE),
        (Base(), HingeCost(BASE_SCENE, 0.3)),
        (Disc(), Cylinder((0.5, 0.1), 0.2)),
    ],
    ids=["arm", "arm in cost field", "base", "base in cost field", "disc"],
)
def test_gradient_of_the_whole_objective(robot, sdf, substeps):
    generator = torch.Generator().manual_seed(3)
    ends = torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(-1, robot.num_dofs)
    q = torch.lerp(ends[0], ends[1], torch.linspace(0, 1, 6, dtype=torch.float64)[:, None])
    q = q + 0.2 * torch.rand(q.shape, generator=generator, dtype=torch.float64)
    objective = _objective(robot, sdf, len(q), substeps)

    def full(interior):
        return torch.cat([q[:1], interior, q[-1:]])

    assert objective(q).total > 0.01
    assert_gradient_matches(
        lambda x: objective(full(x)).total,
        lambda x: objective(full(x)).gradient,
        q[1:-1],
        step=1e-6,
        rtol=1e-3,
        atol=1e-5,
    )


def test_cost_field_and_its_distance_field_give_the_same_objective():
    robot, q = Base(), torch.rand(8, 3, generator=torch.Generator().manual_seed(0))
    plain, wrapped = (_objective(robot, sdf, 8)(q) for sdf in (BASE_SCENE, HingeCost(BASE_SCENE, 0.3)))
    assert float(plain.total) == pytest.approx(float(wrapped.total), rel=1e-5)
    torch.testing.assert_close(plain.gradient, wrapped.gradient, rtol=1e-4, atol=1e-5)
    assert plain.free == wrapped.free


def test_free_is_what_keeps_the_margin():
    line = torch.tensor([[x, 0.0] for x in (0.0, 0.5, 1.0)])
    for gap, free in ((0.001, False), (0.02, True)):
        scene = Cylinder((0.5, 0.3 + gap), 0.2)
        assert _objective(Disc(0.1), scene, 3)(line).free == free


def test_an_arm_folded_into_itself_is_not_free():
    arm, far = PlanarArm((0.4, 0.2, 0.4)), Sphere((50.0, 0.0, 0.0), 1.0)
    for elbow, free in ((1.0, True), (2.9, False)):
        q = torch.tensor([[0.0, 1.0, 1.0], [0.0, elbow, elbow], [0.0, 1.0, 1.0]])
        assert _objective(arm, far, 3)(q).free == free


def test_unknown_space_costs_at_least_as_much_as_a_surface():
    nothing = Sphere((0.0, 0.0, 50.0), 1.0)
    q = torch.tensor([[x, 0.0] for x in (0.0, 1.0, 2.0)])
    field = Confident(nothing, seen_below=0.5)
    assert _objective(Disc(), field, 3)(q).total == _objective(Disc(), nothing, 3)(q).total
    wary = _objective(Disc(), field, 3, unknown_confidence=0.5)(q).total
    surface = 0.5 * 0.3  # c(0)
    assert float(wary - _objective(Disc(), nothing, 3)(q).total) == pytest.approx(1.5 * surface, rel=1e-3)


def test_more_states_a_segment_see_what_lies_between_waypoints():
    q = torch.tensor([[x, 0.0] for x in (0.0, 1.0, 2.0)])
    pole = Cylinder((0.5, 0.0), 0.1)
    coarse = _objective(Disc(), pole, 3, eps=0.1)
    assert coarse(q).free and not coarse.tightened(waypoints_free=True)(q).free
    softer = coarse.tightened(waypoints_free=False)
    assert softer.config.smoothness_weight == coarse.config.smoothness_weight / 4
