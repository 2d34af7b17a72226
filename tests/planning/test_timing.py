import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from planning import ConfigError, Trajectory, retime
from planning.timing import slowdown


def _rates(trajectory):
    """Segment velocities, and accelerations at the waypoints, from rest to rest."""
    dt = trajectory.times.double().diff()[:, None]
    v = trajectory.waypoints.double().diff(dim=0) / dt
    rest = torch.zeros(1, v.shape[1], dtype=v.dtype)
    between = torch.cat([dt[:1], dt[:-1] + dt[1:], dt[-1:]]) / 2
    return v, torch.cat([rest, v, rest]).diff(dim=0) / between


CURVE = torch.stack(
    [torch.linspace(0, 6, 80), torch.linspace(0, 6, 80).sin(), torch.linspace(0, 3, 80).cos()], dim=1
)
PATHS = {
    "curve": CURVE,
    "line": torch.tensor([[0.0, 0.0, 0.0], [1.0, -2.0, 0.01]]),
    "corner": torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1.0]]),
    "there and back": torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]),
    "tiny": torch.tensor([[0.0, 0.0, 0.0], [1e-4, 0.0, 0.0]]),
    "noise": torch.rand(90, 3, generator=torch.Generator().manual_seed(0)),
}


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS.keys())
@pytest.mark.parametrize(
    "v_max, a_max", [([1.0, 0.5, 2.0], [0.5, 1.0, 3.0]), ([0.1] * 3, [10.0] * 3), ([9.0] * 3, [0.2] * 3)]
)
def test_limits_hold_and_the_path_stays(path, v_max, a_max):
    v_max, a_max = torch.tensor(v_max), torch.tensor(a_max)
    timed = retime(Trajectory.through(path), v_max, a_max)
    velocity, acceleration = _rates(timed)
    assert (velocity.abs() <= v_max * (1 + 1e-6)).all()
    assert (acceleration.abs() <= a_max * (1 + 1e-6)).all()
    assert timed.duration > 0 and float(timed.times[0]) == 0
    near = torch.cdist(path.double(), timed.waypoints.double()).amin(dim=1)
    assert float(near.max()) < 1e-6
    assert timed.joint_path_length == pytest.approx(Trajectory.through(path).joint_path_length, rel=1e-4)


def test_a_straight_move_is_a_trapezoid():
    timed = retime(
        Trajectory.line(torch.zeros(1), torch.tensor([2.0]), 200), torch.tensor([1.0]), torch.tensor([2.0])
    )
    assert timed.duration == pytest.approx(2.0 / 1.0 + 1.0 / 2.0, rel=0.01)  # length / v + v / a
    velocity, _ = _rates(timed)
    assert float(velocity.max()) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("name", ["curve", "corner", "noise"])
def test_as_fast_as_the_library_of_the_method(name):
    """toppra on the same spline; a path that turns back is left out, where toppra's grid exceeds the limits."""
    toppra = pytest.importorskip("toppra", reason="toppra is not installed")
    timed = retime(Trajectory.through(PATHS[name]), torch.ones(3), 2 * torch.ones(3))
    q = timed.waypoints.double().numpy()
    knots = np.r_[0.0, np.linalg.norm(np.diff(q, axis=0), axis=1).cumsum()]
    limits = np.array([[-1.0, 1.0]] * 3)
    constraints = [
        toppra.constraint.JointVelocityConstraint(limits),
        toppra.constraint.JointAccelerationConstraint(2 * limits),
    ]
    grid = np.interp(np.arange(4 * len(knots) - 3) / 4, np.arange(len(knots)), knots)
    spline = toppra.SplineInterpolator(knots, q, bc_type="natural")
    library = toppra.algorithm.TOPPRA(constraints, spline, gridpoints=grid).compute_trajectory(0.0, 0.0)
    assert timed.duration == pytest.approx(library.duration, rel=0.01)


def test_no_joint_rests_where_the_path_allows_more():
    """Everywhere some joint is at one of its limits, or nearly: the fastest times have no slack."""
    timed = retime(Trajectory.through(CURVE), torch.ones(3), torch.ones(3))
    velocity, acceleration = _rates(timed)
    busy = torch.maximum(velocity.abs().amax(1), acceleration[1:].abs().amax(1))
    assert float(busy.min()) > 0.8 and float(busy.mean()) > 0.97


@given(
    steps=arrays(np.float64, st.tuples(st.integers(1, 12), st.just(2)), elements=st.floats(-2, 2)),
    v_max=st.floats(0.01, 10),
    a_max=st.floats(0.01, 100),
)
@settings(max_examples=60, deadline=None)
def test_no_path_gets_no_time_or_breaks_limits(steps, v_max, a_max):
    path = torch.from_numpy(np.cumsum(np.r_[np.zeros((1, 2)), steps], axis=0))
    limits = torch.tensor([v_max, 2 * v_max]).double(), torch.tensor([a_max, a_max]).double()
    timed = retime(Trajectory.through(path), *limits)
    assert timed.duration > 0 and torch.isfinite(timed.times).all() and (timed.times.diff() > 0).all()
    velocity, acceleration = _rates(timed)
    assert (velocity.abs() <= limits[0] * (1 + 1e-6)).all()
    assert (acceleration.abs() <= limits[1] * (1 + 1e-6)).all()


def test_slowdown_measures_what_breaks_the_limits():
    path, times = torch.tensor([[0.0], [1.0], [2.0]]).double(), torch.tensor([0.0, 1.0, 2.0]).double()
    # Velocity 1, from rest within half a second of the first segment's time: acceleration 2.
    assert slowdown(path, times, torch.tensor([0.5]), torch.tensor([100.0])) == pytest.approx(2)
    assert slowdown(path, times, torch.tensor([5.0]), torch.tensor([0.5])) == pytest.approx(2)
    assert slowdown(path, times, torch.tensor([5.0]), torch.tensor([5.0])) == pytest.approx(1)


def test_looser_limits_are_never_slower():
    slow = retime(Trajectory.through(CURVE), torch.ones(3), torch.ones(3)).duration
    fast = retime(Trajectory.through(CURVE), 2 * torch.ones(3), 4 * torch.ones(3)).duration
    assert fast == pytest.approx(slow / 2, rel=1e-3)


def test_standing_still_takes_some_time():
    for n in (1, 5):
        timed = retime(Trajectory.line(torch.ones(2), torch.ones(2), n), torch.ones(2), torch.ones(2))
        assert timed.duration > 0 and torch.equal(timed.waypoints[-1], torch.ones(2))


def test_unlimited_joints_need_only_one_kind_of_limit():
    line, none = Trajectory.line(torch.zeros(2), torch.ones(2)), torch.tensor([math.inf, math.inf])
    assert retime(line, none, torch.ones(2)).duration > 0
    assert retime(line, torch.ones(2), none).duration > 0
    with pytest.raises(ConfigError, match="neither"):
        retime(line, none, none)


@pytest.mark.parametrize("limits", [torch.tensor([1.0, 0.0]), torch.ones(1), torch.tensor([1.0, math.nan])])
def test_bad_limits_are_refused(limits):
    with pytest.raises(ConfigError, match="velocity_limits must be 2 positive numbers"):
        retime(Trajectory.line(torch.zeros(2), torch.ones(2)), limits, torch.ones(len(limits)))
