import math

import pytest
import torch

from planning import FieldError
from planning.workspace import Workspace, WorkspaceConfig
from tests.planning.fields import Box, Cylinder, HalfSpace, HingeCost, NanBeyond, Room, Sphere, Union
from tests.planning.robots import Base, Disc

WALLED = Union(HalfSpace(), Room(Box((0.0, 0.0, 1.0), (1.0, 1.0, 1.0))))


def _clearance(robot, sdf, q):
    return Workspace(robot, sdf, eps=0.2).clearance(*robot.spheres(torch.tensor(q)))


def test_floor_spheres_may_touch_the_floor_only():
    robot = Base()
    on_floor = _clearance(robot, WALLED, [0.0, 0.0, 0.0])
    assert on_floor[:3].isinf().all() and (on_floor[3:] > 0).all()
    low = torch.zeros(6, dtype=torch.bool)
    robot.floor_spheres = low
    assert _clearance(robot, WALLED, [0.0, 0.0, 0.0])[:3] == pytest.approx([0.0] * 3, abs=1e-6)


@pytest.mark.parametrize("depth", [0.01, 0.03, 0.05, 0.2])
def test_a_wall_nearer_than_the_floor_counts_for_floor_spheres(depth):
    """Also where the wall is so near to the floor's distance that the distance alone could not tell."""
    robot = Base()
    x = 1.0 - 0.2 - 0.1 + depth  # the foremost sphere reaches `depth` into the wall
    clearance = _clearance(robot, WALLED, [x, 0.0, 0.0])
    assert float(clearance[2]) == pytest.approx(-depth, abs=1e-5)
    for sdf in (WALLED, HingeCost(WALLED, 0.2)):
        cost, _ = Workspace(robot, sdf, eps=0.2).cost_and_gradient(
            *robot.spheres(torch.tensor([x, 0.0, 0.0]))
        )
        assert float(cost[2]) == pytest.approx(0.1 + depth, abs=1e-5) and float(cost[0]) == 0.0


def test_a_mapped_floor_may_be_wrong_by_the_tolerance():
    robot, tolerance = Base(), WorkspaceConfig().floor_tolerance
    for error, exempt in ((0.9 * tolerance, True), (-0.9 * tolerance, True), (1.5 * tolerance, False)):
        clearance = _clearance(robot, HalfSpace(offset=error), [0.0, 0.0, 0.0])
        assert bool(clearance[:3].isinf().all()) is exempt


def test_queries_in_chunks_agree_and_keep_the_batch_shape():
    robot, field = Disc(), Union(Sphere((0.0, 0.0, 0.3), 0.4), Cylinder((1.0, 1.0), 0.2))
    centres, radii = robot.spheres(torch.rand(3, 5, 2))
    whole = Workspace(robot, field, 0.1)
    parts = Workspace(robot, field, 0.1, config=type(whole.config)(chunk=4))
    assert whole.clearance(centres, radii).shape == (3, 5, 1)
    torch.testing.assert_close(whole.clearance(centres, radii), parts.clearance(centres, radii))


def test_nan_is_passed_on():
    assert math.isnan(float(_clearance(Disc(), NanBeyond(Sphere((9.0, 0.0, 0.0), 1.0), 0.0), [0.5, 0.0])[0]))


def test_something_that_is_no_field_is_refused():
    class Hollow:
        eps = 0.1
        field = None

        def cost_and_gradient(self, points, radii):
            return points[..., 0], points

    with pytest.raises(FieldError, match="NoneType is no field"):
        Workspace(Disc(), Hollow(), 0.1)
