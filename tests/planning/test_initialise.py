import math

import pytest
import torch

from planning import (
    NoPath,
    RrtConfig,
    Trajectory,
    TrajectoryError,
    ValidationConfig,
    WorkspaceConfig,
    check,
    rrt_connect,
)
from planning.initialise import StateSpace
from tests.planning.fields import Box, Confident, Cylinder, NanBeyond, Sphere, Union, walls_round
from tests.planning.robots import Base, Disc, PlanarArm

FAR = Sphere((50.0, 0.0, 0.0), 1.0)
TRAP = Union(
    Box((2.0, 0.0, 0.5), (0.1, 1.0, 2.0)),
    Box((1.3, 1.0, 0.5), (0.8, 0.1, 2.0)),
    Box((1.3, -1.0, 0.5), (0.8, 0.1, 2.0)),
)


def _valid(robot, path, field, margin=0.0):
    return check(robot, Trajectory.through(path), field, ValidationConfig(margin=margin)).success


@pytest.mark.parametrize("seed", range(4))
def test_leaves_a_trap_with_the_margin(seed):
    start, goal = torch.tensor([1.0, 0.0]), torch.tensor([4.0, 0.5])
    path = rrt_connect(Disc(), TRAP, start, goal, RrtConfig(margin=0.03), seed)
    assert not isinstance(path, NoPath), path
    assert torch.equal(path[0], start) and torch.equal(path[-1], goal)
    assert _valid(Disc(), path, TRAP, margin=0.02)
    length = float(path.diff(dim=0).norm(dim=1).sum())
    assert length < 6.5  # the shortest is about 5.4 m


def test_the_seed_decides():
    start, goal = torch.tensor([1.0, 0.0]), torch.tensor([4.0, 0.5])
    first, again, other = (rrt_connect(Disc(), TRAP, start, goal, seed=seed) for seed in (5, 5, 6))
    assert torch.equal(first, again) and (first.shape != other.shape or not torch.equal(first, other))


def test_free_space_needs_two_vertices():
    assert len(rrt_connect(Base(), FAR, torch.zeros(3), torch.ones(3))) == 2


@pytest.mark.parametrize("links", [3, 7])
def test_arms(links):
    arm = PlanarArm((1.2 / links,) * links, per_link=3, radius=0.03)
    scene = Union(Sphere((0.8, 0.1, 0.5), 0.15), Sphere((0.4, 0.9, 0.5), 0.1), Sphere((0.0, -0.9, 0.5), 0.1))
    start, goal = torch.zeros(links), torch.zeros(links)
    start[0], goal[0] = -0.8, 0.7
    path = rrt_connect(arm, scene, start, goal)
    assert not isinstance(path, NoPath), path
    assert len(path) > 2 and _valid(arm, path, scene)


def test_no_path_to_a_walled_in_goal_within_its_time():
    config = RrtConfig(seconds=0.5)
    result = rrt_connect(Disc(), walls_round(2.0), torch.zeros(2), torch.tensor([2.0, 0.0]), config)
    assert isinstance(result, NoPath) and "0.5 s" in result.message
    result = rrt_connect(
        Disc(), walls_round(2.0), torch.zeros(2), torch.tensor([2.0, 0.0]), RrtConfig(max_nodes=300)
    )
    assert isinstance(result, NoPath) and "300 nodes" in result.message


def test_blocked_ends_and_nan_are_named():
    pole = Cylinder((0.0, 0.0), 0.3)
    near, far = torch.zeros(2), torch.tensor([2.0, 0.0])
    assert "start" in rrt_connect(Disc(), pole, near, far).message
    assert "goal" in rrt_connect(Disc(), pole, far, near).message
    assert "goal" in rrt_connect(Disc(), NanBeyond(FAR, 1.0), near, far).message


def test_unknown_space_is_blocked_where_asked():
    """The way round the wall through the unseen gap is not taken."""
    field = Confident(
        Union(Box((1.0, 2.0, 0.3), (0.2, 2.3, 1.0)), Box((1.0, -5.0, 0.3), (0.2, 4.0, 1.0))), 0.0
    )
    field.confidence = lambda points: (points[..., 1] > -0.35).to(points)
    start, goal = torch.tensor([0.0, 0.0]), torch.tensor([2.0, 0.0])
    assert not isinstance(rrt_connect(Disc(), field, start, goal), NoPath)
    wary = RrtConfig(workspace=WorkspaceConfig(unknown_confidence=0.5), seconds=0.5)
    assert isinstance(rrt_connect(Disc(), field, start, goal, wary), NoPath)


def test_edges_are_free_up_to_the_first_obstacle():
    space = StateSpace(
        Disc(), Cylinder((1.0, 0.0), 0.2), torch.zeros(2), torch.ones(2), RrtConfig(margin=0.0)
    )
    ends = torch.tensor([[2.0, 0.0], [0.5, 0.0], [0.0, 2.0]])
    reached = space.advance(torch.zeros(3, 2), ends)
    torch.testing.assert_close(reached, torch.tensor([0.35, 1.0, 1.0]), rtol=0, atol=0.02)


def test_configurations_that_are_not_free():
    arm = PlanarArm((0.4, 0.2, 0.4))
    space = StateSpace(arm, Sphere((0.8, 0.0, 0.5), 0.1), torch.zeros(3), torch.ones(3), RrtConfig())
    folded, outside, touching, fine = [1.5, 2.9, 2.9], [1.5, 3.1, 0.0], [0.0, 0.0, 0.0], [1.5, 0.0, 0.0]
    assert space.free(torch.tensor([folded, outside, touching, fine])).tolist() == [False, False, False, True]


def test_joints_weigh_what_they_move():
    arm = PlanarArm((0.5, 0.5), per_link=10)
    space = StateSpace(arm, FAR, torch.zeros(2), torch.zeros(2), RrtConfig())
    torch.testing.assert_close(space.weights, torch.tensor([0.975, 0.475]), rtol=0, atol=0.02)


def test_mismatched_joints_are_refused():
    with pytest.raises(TrajectoryError, match="start has 3 joints, the robot has 2"):
        rrt_connect(Disc(), FAR, torch.zeros(3), torch.zeros(3))


@pytest.mark.parametrize("limit", [math.inf, 500.0])
def test_a_base_in_a_wide_hall_is_sampled_near_its_ends(limit):
    start, goal = torch.tensor([1.0, 0.0]), torch.tensor([4.0, 0.5])
    space = StateSpace(Disc(limit=limit), TRAP, start, goal, RrtConfig(unlimited_range=2.0))
    assert space.low.tolist() == [-1.0, -2.0] and space.high.tolist() == [6.0, 2.5]
    path = rrt_connect(Disc(limit=limit), TRAP, start, goal)
    assert not isinstance(path, NoPath), path


def test_narrow_limits_are_sampled_whole():
    space = StateSpace(Disc(limit=3.0), FAR, torch.zeros(2), torch.zeros(2), RrtConfig(unlimited_range=1.0))
    assert space.low.tolist() == [-3.0, -3.0] and space.high.tolist() == [3.0, 3.0]
