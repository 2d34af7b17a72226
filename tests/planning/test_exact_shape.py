"""Compiled kinematics, collision tests and search against what is slow and simple."""

import json

import numpy as np
import pytest
import torch

from planning import (
    AxisConstraint,
    Chomp,
    ChompConfig,
    GoalPose,
    NoPath,
    Planner,
    PrimitiveField,
    RrtConfig,
    Solid,
    Status,
    Trajectory,
    check,
    rrt_connect,
)
from planning.constraints import violation
from planning.errors import ProblemError, TrajectoryError
from planning.exact_shape import exact_shape
from planning.problems import load_problems
from planning.solve import Solver
from planning.sphere_kinematics import CompiledKinematics, TorchKinematics

robots = pytest.importorskip("robots")

SHELF = PrimitiveField(
    [Solid("box", (0.5, 0.02, 0.8), (0.5, 0.15, 0.4)), Solid("cylinder", (0.8, 0.1), (0.4, -0.4, 0.4))]
)


@pytest.fixture(scope="module")
def panda():
    return robots.load("panda")


def _states(robot, n, seed=0):
    low, high = robot.joint_limits.double().clamp(-3, 3).unbind(1)
    return low + (high - low) * torch.rand(
        n, robot.num_dofs, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


@pytest.mark.parametrize("name", ["panda", "tiago"])
def test_compiled_kinematics_agree_with_autograd(name):
    robot = robots.load(name)
    slow, fast, q = TorchKinematics(robot), CompiledKinematics(robot), _states(robot, 20)
    centres = slow.centres(q)
    torch.testing.assert_close(fast.centres(q), centres, rtol=0, atol=1e-6)
    forces = torch.randn(centres.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(
        fast.pull_back(q, centres, forces), slow.pull_back(q, centres, forces), rtol=1e-5, atol=1e-5
    )


def _by_brute_force(robot, field, q):
    """Least clearance from solids and least gap between links over all fine spheres."""
    frame, balls, link = robot.fine_spheres()
    chain, clearances, gaps = robot.chain, [], []
    from planning.compiled.arrays import chain_of
    from planning.compiled.kinematics import place, poses

    for state in q.numpy():
        centres = place(poses(chain_of(robot), state), frame, np.ascontiguousarray(balls[:, :3]))
        clearances.append(float((field.distance(torch.tensor(centres)) - torch.tensor(balls[:, 3])).min()))
        least = np.inf
        for a, b in robot.link_pairs:
            between = np.linalg.norm(centres[link == a][:, None] - centres[link == b][None], axis=2)
            least = min(least, (between - balls[link == a, 3][:, None] - balls[link == b, 3][None]).min())
        gaps.append(least)
    assert len(chain.parent) == robot.num_dofs
    return np.array(clearances), np.array(gaps)


def test_states_are_measured_as_by_brute_force(panda):
    q = _states(panda, 12)
    shape = exact_shape(panda, SHELF)
    clearances, gaps = _by_brute_force(panda, SHELF, q)
    for i in range(len(q)):
        depth, _, gap, _ = shape.measure(q[i : i + 1], 0.0, 0.0)
        assert float(depth[0]) == pytest.approx(clearances[i], abs=1e-6)
        assert float(gap[0]) == pytest.approx(min(gaps[i], 0.05), abs=1e-6)
    from planning.compiled.states import free

    world = shape.world
    assert [free(world, state) for state in q.numpy()] == [
        c >= 0 and g >= 0 for c, g in zip(clearances, gaps, strict=True)
    ]
    assert 0 < sum(c >= 0 and g >= 0 for c, g in zip(clearances, gaps, strict=True)) < len(q)


FLOOR = Solid("box", (8, 8, 0.1), (0, 0, -0.05))
KERB, STEP = Solid("box", (0.1, 3, 0.06), (0.8, 0, 0.03)), Solid("box", (3, 3, 0.15), (2.3, 0, 0.0))


@pytest.mark.parametrize(
    ("solids", "x", "is_free"),
    [
        ((FLOOR,), 0.8, True),
        ((FLOOR, KERB), 0.8, False),
        ((FLOOR, KERB), 0.0, True),
        ((FLOOR, STEP), 0.8, False),
    ],
    ids=["on the floor", "over a kerb", "before the kerb", "in a step"],
)
def test_wheels_may_touch_the_floor_and_nothing_else(solids, x, is_free):
    """The compiled rule for the floor, which decides alone where robot and field can be compiled."""
    field, tiago = PrimitiveField(list(solids)), robots.load("tiago")
    q = tiago.named["tucked"].double()
    q[0] = x
    shape = exact_shape(tiago, field)
    assert shape is not None and tiago.floor_spheres.any()
    from planning.compiled.states import free

    depth = float(shape.measure(q[None], 0.0, 0.0)[0][0])
    assert free(shape.world, q.numpy()) == (depth >= 0) == is_free, depth
    assert check(tiago, Trajectory(q[None], torch.zeros(1)), field).success == is_free


def test_the_search_finds_a_checked_path_and_repeats(panda):
    start = panda.named["ready"].double()
    goal = start.clone()
    goal[0] += 1.2
    assert not check(panda, Trajectory.line(start, goal), SHELF).success
    config = RrtConfig(seconds=60.0, candidates=1)
    path, again = (rrt_connect(panda, SHELF, start, goal, config, seed=3) for _ in range(2))
    assert not isinstance(path, NoPath) and torch.equal(path, again)
    assert torch.equal(path[0], start) and torch.equal(path[-1], goal)
    assert check(panda, Trajectory.through(path), SHELF).success
    result = Planner(panda).plan(start, goal, SHELF)
    assert result.success and check(panda, result.trajectory, SHELF).success, result.message


def test_a_walled_in_goal_has_no_path(panda):
    start = panda.named["ready"].double()
    cage = PrimitiveField(
        [Solid("box", (0.02, 3.0, 3.0), (0.2, 0.0, 1.5)), Solid("box", (3.0, 3.0, 0.02), (0, 0, 1.4))]
    )
    verdict = Planner(panda).plan(start, start + 0.1, cage)
    assert verdict.status is Status.START_IN_COLLISION


def test_constraints_hold_at_every_waypoint_and_the_goal_is_a_pose(panda):
    start = panda.named["ready"].double()

    def hand(q):
        return panda.link_poses(q, ["panda_hand"])[..., 0, :, :]

    target = hand(start).clone()
    target[:3, 3] += torch.tensor([0.05, 0.25, 0.1], dtype=torch.float64)
    upright = AxisConstraint(hand, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, -1.0]))
    goal = GoalPose(hand, target, free_axis=2)
    aside = PrimitiveField([Solid("sphere", (0.1,), (0.5, -0.6, 0.2))])
    guess = Trajectory.line(start, start, 20)
    result = Chomp(panda, ChompConfig()).optimise(guess, aside, constraints=[upright, goal])
    assert result.success, result.message
    q = result.trajectory.waypoints
    assert torch.equal(q[0], start) and violation([upright, goal], q) < 1e-3
    assert float((hand(q[-1])[:3, 3] - target[:3, 3]).norm()) < 1e-3


def test_a_batch_returns_a_valid_one_and_needs_equal_lengths(panda):
    start = panda.named["ready"].double()
    lines = [Trajectory.line(start, start + turn, 20) for turn in (0.1, 0.2)]
    assert Chomp(panda).optimise(lines, PrimitiveField([])).success
    with pytest.raises(TrajectoryError, match="as many waypoints"):
        Chomp(panda).optimise([lines[0], Trajectory.line(start, start + 0.1, 30)], SHELF)
    with pytest.raises(TrajectoryError, match="no trajectory"):
        Chomp(panda).optimise([], SHELF)


def test_problems_are_solved_in_the_order_of_their_joints(panda, tmp_path):
    start, goal = panda.named["ready"].tolist(), (panda.named["ready"] + 0.3).tolist()
    names = list(panda.joint_names)
    entry = {
        "set": "s",
        "index": 1,
        "joints": names[::-1],
        "start": start[::-1],
        "goal": goal[::-1],
        "start_all": {"panda_finger_joint1": 0.02},
        "obstacles": [
            {"type": "box", "dimensions": [0.1] * 3, "position": [-0.6, 0, 0.2], "quat_xyzw": [0, 0, 0, 1]}
        ],
    }
    (tmp_path / "p.json").write_text(json.dumps({"problems": [entry]}))
    (problem,) = load_problems(tmp_path / "p.json")
    result = Solver(panda).solve(problem)
    assert result["status"] == "success" and result["clearance"] > 0
    assert (
        result["waypoints"][0] == problem.start.tolist() and result["waypoints"][-1] == problem.goal.tolist()
    )
    times = torch.tensor(result["times"], dtype=torch.float64)
    speed = torch.tensor(result["waypoints"], dtype=torch.float64).diff(dim=0) / times.diff()[:, None]
    assert (times.diff() > 0).all()
    assert (speed.abs() <= panda.velocity_limits.flip(0) * (1 + 1e-6)).all()


@pytest.mark.parametrize(
    "change, match",
    [
        ({"goal": [0.0]}, "start has 2 values and goal 1"),
        ({"start": [float("nan"), 0.0]}, "finite"),
        ({"obstacles": [{"type": "box"}]}, "dimensions"),
        ({"joints": None}, "TypeError"),
    ],
)
def test_malformed_problems_are_refused(tmp_path, change, match):
    entry = {
        "set": "s",
        "index": 1,
        "joints": ["a", "b"],
        "start": [0.0, 0.0],
        "goal": [1.0, 1.0],
        "obstacles": [],
    }
    (tmp_path / "p.json").write_text(json.dumps({"problems": [{**entry, **change}]}))
    with pytest.raises(ProblemError, match=match):
        load_problems(tmp_path / "p.json")
    (tmp_path / "q.json").write_text("no json")
    for bad in ("q.json", "missing.json"):
        with pytest.raises(ProblemError, match="no JSON file"):
            load_problems(tmp_path / bad)
