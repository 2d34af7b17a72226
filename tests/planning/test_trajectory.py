import math

import pytest
import torch

from planning import Trajectory, TrajectoryError


def test_line_starts_and_ends_exactly_and_is_even():
    start, goal = torch.rand(5), torch.rand(5) * 3
    line = Trajectory.line(start, goal, num_waypoints=17, duration=2.0)
    assert torch.equal(line.waypoints[0], start) and torch.equal(line.waypoints[-1], goal)
    steps = line.waypoints.diff(dim=0)
    torch.testing.assert_close(steps, steps[:1].expand_as(steps), rtol=1e-3, atol=1e-6)
    assert line.duration == pytest.approx(2.0)
    assert line.joint_path_length == pytest.approx(float((goal - start).norm()), rel=1e-5)


def test_at_interpolates_linearly_and_clamps():
    trajectory = Trajectory(torch.tensor([[0.0], [1.0], [5.0]]), torch.tensor([1.0, 2.0, 4.0]))
    times = torch.tensor([[0.0, 1.0, 1.5], [3.0, 4.0, 9.0]])
    expected = torch.tensor([[0.0, 0.0, 0.5], [3.0, 5.0, 5.0]])
    torch.testing.assert_close(trajectory.at(times)[..., 0], expected)
    assert trajectory.at(1.25).shape == (1,)


def test_resampling_to_the_same_times_changes_nothing():
    trajectory = Trajectory.line(torch.zeros(2), torch.ones(2), 11)
    torch.testing.assert_close(trajectory.resampled(11).waypoints, trajectory.waypoints)
    fine = trajectory.resampled(101)
    torch.testing.assert_close(trajectory.at(fine.times), fine.waypoints)


def test_through_spreads_evenly_by_arc_length_or_keeps_vertices():
    path = torch.tensor([[0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [3.0, 1.0]])
    even = Trajectory.through(path, 9)
    torch.testing.assert_close(even.waypoints.diff(dim=0).norm(dim=1), torch.full((8,), 0.5))
    vertices = Trajectory.through(path, duration=4.0)
    torch.testing.assert_close(vertices.waypoints, path[[0, 1, 3]])
    torch.testing.assert_close(vertices.times, torch.tensor([0.0, 3.0, 4.0]))


def test_standing_still_is_a_trajectory():
    q = torch.tensor([0.3, -1.0])
    line = Trajectory.line(q, q, 5)
    assert torch.equal(line.waypoints, q.expand(5, -1))
    assert len(Trajectory.through(torch.stack([q, q]))) == 1
    one = Trajectory(q[None], torch.zeros(1))
    assert one.duration == 0 and torch.equal(one.at(torch.tensor([-1.0, 2.0])), q.expand(2, -1))


@pytest.mark.parametrize(
    "waypoints, times, offender",
    [
        (torch.zeros(0, 2), torch.zeros(0), "0 waypoints"),
        (torch.tensor([[0.0], [math.nan]]), torch.tensor([0.0, 1.0]), "waypoint 1"),
        (torch.zeros(3, 1), torch.tensor([0.0, 1.0, 1.0]), r"times\[1\]"),
        (torch.zeros(2, 1), torch.tensor([0.0, math.inf]), "finite"),
    ],
)
def test_malformed_trajectories_are_refused(waypoints, times, offender):
    with pytest.raises(TrajectoryError, match=offender):
        Trajectory(waypoints, times)


def test_resampling_one_waypoint_is_refused():
    with pytest.raises(TrajectoryError, match="one waypoint"):
        Trajectory(torch.zeros(1, 2), torch.zeros(1)).resampled(5)


def test_waypoints_that_hardly_differ_share_a_time_and_the_last_one_stays():
    path = torch.tensor([[0.0, 0.0], [1e-30, 0.0], [1.0, 0.0], [1.0, 1e-30]])
    timed = Trajectory.through(path)
    assert len(timed) == 2 and torch.equal(timed.waypoints[[0, -1]], path[[0, -1]])
    assert len(Trajectory.through(path[:1].expand(3, 2))) == 1
