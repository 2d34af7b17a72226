"""What planning says to inputs that it cannot use."""

import json
import time

import numpy as np
import pytest
import torch

from planning import (
    Chomp,
    Planner,
    PrimitiveField,
    Solid,
    Status,
    Trajectory,
    TrajectoryError,
    check,
    nearest_free,
)
from planning.cli import load_robot
from planning.errors import ProblemError
from planning.problems import load_problems
from planning.solve import Solver
from tests.planning.fields import AutogradField, Cylinder, Sphere, walls_round
from tests.planning.robots import Disc, PlanarArm

FAR = Sphere((50.0, 0.0, 0.0), 1.0)
START, GOAL = torch.zeros(2), torch.tensor([2.0, 0.0])
LINE = Trajectory.line(START, GOAL, 30)


class NanGradient(Cylinder):
    """Distances are right, their gradients are not there."""

    def distance_and_gradient(self, points):
        distance, gradient = super().distance_and_gradient(points)
        return distance, torch.full_like(gradient, torch.nan)


class Constant(AutogradField):
    def __init__(self, value):
        self.value = value

    def distance(self, points):
        return 0 * points[..., 0] + self.value


def test_nan_in_the_gradient_is_an_invalid_field_and_no_success_is_made_up():
    result = Chomp(Disc()).optimise(LINE, NanGradient((1.0, 0.05), 0.3))
    assert result.status is Status.INVALID_FIELD and "gradient is NaN" in result.message
    assert torch.isfinite(result.trajectory.waypoints).all()
    free = Chomp(Disc()).optimise(LINE, NanGradient((1.0, 3.0), 0.3))
    assert free.success  # nothing had to be descended


def test_the_search_needs_no_gradient():
    field = NanGradient((1.0, 0.05), 0.3)
    result = Planner(Disc()).plan(START, GOAL, field)
    assert result.success and check(Disc(), result.trajectory, field).success


@pytest.mark.parametrize("value", [0.0, -1.0, torch.nan])
def test_a_field_of_one_value_is_no_map(value):
    for result in (
        Chomp(Disc()).optimise(LINE, Constant(value)),
        Planner(Disc()).plan(START, GOAL, Constant(value)),
    ):
        assert result.status is Status.INVALID_FIELD
        assert ("NaN" if value != value else "map of nothing") in result.message
    assert Chomp(Disc()).optimise(LINE, Constant(5.0)).success  # all free is a map


@pytest.mark.parametrize("end", ["start", "goal"])
def test_a_blocked_end_comes_with_the_nearest_free_one(end):
    pole = Cylinder((0.0, 0.1), 0.3)  # the disc at 0 has to go 0.3 m down
    ends = (START, GOAL) if end == "start" else (GOAL, START)
    for result in (
        Chomp(Disc()).optimise(Trajectory.line(*ends, 20), pole),
        Planner(Disc()).plan(*ends, pole),
    ):
        nearest = result.nearest_free
        assert result.status in (Status.START_IN_COLLISION, Status.GOAL_IN_COLLISION)
        assert f"nearest free {end} found" in result.message
        assert check(Disc(), Trajectory(nearest[None], torch.zeros(1)), pole).success
        assert 0.3 <= float(nearest.norm()) < 0.36
        other = ends[1] if end == "start" else ends[0]
        again = Planner(Disc()).plan(*((nearest, other) if end == "start" else (other, nearest)), pole)
        assert again.success and again.nearest_free is None


def test_an_end_beyond_the_limits_comes_with_the_nearest_one_within():
    result = Planner(PlanarArm()).plan(torch.tensor([0.0, 3.3]), torch.zeros(2), FAR)
    assert result.status is Status.JOINT_LIMITS and "joint2" in result.message
    assert result.nearest_free.tolist() == [0.0, 3.0]


def test_an_arm_folded_into_itself_is_unfolded():
    arm, folded = PlanarArm((0.4, 0.2, 0.4)), torch.tensor([0.0, 2.9, 2.9])
    nearest = nearest_free(arm, folded, FAR)
    assert check(arm, Trajectory(nearest[None], torch.zeros(1)), FAR).success
    assert 0 < float((nearest - folded).norm()) < 1.75


def test_where_everything_is_blocked_nothing_is_offered():
    result = Planner(Disc()).plan(START, GOAL, Sphere((0.0, 0.0, 0.3), 40.0))
    assert result.status is Status.START_IN_COLLISION and result.nearest_free is None
    assert "no free configuration was found" in result.message


def test_an_unreachable_goal_is_no_path_and_says_why():
    result = Planner(Disc()).plan(START, GOAL, walls_round(2.0), deadline=0.5)
    assert result.status is Status.NO_PATH and not result.success and "no path found" in result.message


@pytest.mark.parametrize(
    "start, goal, match",
    [
        (
            torch.zeros(3),
            torch.zeros(3),
            r"start has shape \(3,\), but the robot has 2 joints: base_x, base_y",
        ),
        (torch.tensor([0.0, torch.nan]), torch.zeros(2), "start must be finite"),
        (torch.zeros(2), torch.tensor([[0.0, torch.inf]]), "goal must be finite"),
        (torch.zeros(2), torch.zeros(0, 2), r"goal has shape \(0, 2\)"),
    ],
)
def test_ends_that_do_not_fit_the_robot(start, goal, match):
    with pytest.raises(TrajectoryError, match=match):
        Planner(Disc()).plan(start, goal, FAR)


def test_a_warm_start_that_does_not_fit_the_robot():
    with pytest.raises(TrajectoryError, match="warm_start has shape"):
        Planner(Disc()).plan(START, GOAL, FAR, warm_start=Trajectory.line(torch.zeros(3), torch.ones(3)))


JOINT = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><axis xyz="{4}"/>{5}</joint>'
LIMIT = '<limit lower="{}" upper="{}" effort="1" velocity="1"/>'


@pytest.fixture
def odd(tmp_path):
    """A slide on a turntable without limits, and a flap that mimics the slide."""
    robots = pytest.importorskip("robots")
    path = tmp_path / "odd.urdf"
    path.write_text(
        '<robot name="odd">'
        + "".join(f'<link name="{name}"/>' for name in "abcd")
        + JOINT.format("spin", "continuous", "a", "b", "0 0 1", '<limit effort="1" velocity="2"/>')
        + JOINT.format("slide", "prismatic", "b", "c", "1 0 0", LIMIT.format(0.3, 1.0))
        + JOINT.format("flap", "revolute", "c", "d", "0 0 1", LIMIT.format(-9, 9)).replace(
            "</joint>", '<mimic joint="slide" multiplier="2" offset="0.1"/></joint>'
        )
        + "</robot>"
    )
    rows = {"c": np.array([[0.0, 0, 0, 0.1]]), "d": np.array([[0.3, 0, 0, 0.05]])}
    return robots.Robot.from_urdf(path, robots.SphereSet(rows))


def test_continuous_prismatic_and_mimicking_joints_are_planned(odd):
    from planning.sphere_kinematics import CompiledKinematics, TorchKinematics

    slow, fast = TorchKinematics(odd), CompiledKinematics(odd)
    q = torch.tensor([[9.0, 0.4], [-2.0, 0.9]], dtype=torch.float64)
    centres = slow.centres(q)
    torch.testing.assert_close(fast.centres(q), centres, rtol=0, atol=1e-6)
    forces = torch.ones_like(centres)
    torch.testing.assert_close(fast.pull_back(q, centres, forces), slow.pull_back(q, centres, forces))
    field = PrimitiveField([Solid("box", (0.3, 0.2, 0.5), (0.9, 0.0, 0.0))])
    start, goal = torch.tensor([-0.9, 0.9]).double(), torch.tensor([0.9, 0.9]).double()
    assert not check(odd, Trajectory.line(start, goal), field).success
    result = Planner(odd).plan(start, goal, field)
    assert result.success, result.message
    assert float(result.trajectory.waypoints[:, 1].min()) < 0.7  # it had to draw in
    over = Planner(odd).plan(torch.tensor([50.0, 0.5]).double(), torch.tensor([50.5, 0.5]).double(), field)
    assert over.success  # a continuous joint may have turned often


def _problem(tmp_path, **change):
    entry = {
        "set": "s",
        "index": 1,
        "joints": ["spin", "slide"],
        "start": [-0.9, 0.9],
        "goal": [1.0, 0.9],
        "obstacles": [{"type": "box", "dimensions": [0.3, 0.2, 0.5], "position": [0.9, 0, 0]}],
    }
    (tmp_path / "p.json").write_text(json.dumps({"problems": [{**entry, **change}]}))
    return load_problems(tmp_path / "p.json")[0]


def test_problems_with_bad_ends_get_a_status_and_bad_names_an_error(odd, tmp_path):
    solver = Solver(odd)
    assert solver.solve(_problem(tmp_path))["status"] == "success"
    hit = solver.solve(_problem(tmp_path, start=[0.0, 0.9]))
    assert hit["status"] == "start in collision" and "nearest free start" in hit["message"]
    outside = solver.solve(_problem(tmp_path, goal=[1.0, 1.5]))
    assert outside["status"] == "joint limits" and "slide" in outside["message"]
    assert np.isfinite(outside["times"]).all() and outside["times"][-1] > 0
    with pytest.raises(ProblemError, match=r"no joints \['tilt'\]; it plans \('spin', 'slide'\)"):
        solver.solve(_problem(tmp_path, joints=["spin", "tilt"]))


def test_a_deadline_of_zero_is_answered_at_once(odd, tmp_path):
    solver = Solver(odd)
    solver.solve(_problem(tmp_path))  # compiles
    started = time.process_time()
    result = solver.solve(_problem(tmp_path), deadline=0.0)
    assert result["status"] == "no path" and time.process_time() - started < 0.1
    blocked = solver.solve(_problem(tmp_path, start=[0.0, 0.9]), deadline=0.0)
    assert blocked["status"] == "start in collision" and "nearest" not in blocked["message"]


def test_loaders_that_give_no_robot():
    for loader in ("nothing:load", "planning:load", "robots:load"):
        with pytest.raises(ProblemError, match="gives no robot"):
            load_robot(loader, "r2d2")
