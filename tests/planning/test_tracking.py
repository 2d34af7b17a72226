import math
import time

import numpy as np
import pytest

from planning import ConfigError, TrajectoryError
from planning.tracking import BaseTracker, TrackerConfig
from planning.unicycle_mpc import UnicycleMpc

S = np.linspace(0, 4, 80)
S_CURVE = np.stack([S, 0.6 * np.sin(S * np.pi / 2)], axis=1)
L_PATH = np.array([[0.0, 0.0], [1.5, 0.0], [1.5, 1.5], [0.0, 1.5]])


def _drive(path, state, times=None, final_yaw=None, config=None, slip=1.0, periods=500):
    """Simulate a unicycle at 100 Hz; states, commands and whether it finished."""
    tracker = BaseTracker(config)
    state, states, commands = np.array(state, dtype=float), [], []
    for _ in range(periods):
        v, omega = tracker.command(state, path, times, final_yaw)
        commands.append((v, omega))
        if tracker.finished:
            break
        for _ in range(10):
            states.append(state)
            state = state + 0.01 * slip * np.array([v * math.cos(state[2]), v * math.sin(state[2]), omega])
    return np.array([*states, state]), np.array(commands), tracker.finished


def _lateral(states, path):
    arc = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    fine = np.stack([np.interp(np.linspace(0, arc[-1], 4000), arc, path[:, i]) for i in (0, 1)], axis=1)
    return np.array([np.linalg.norm(fine - s[:2], axis=1).min() for s in states[::5]])


@pytest.mark.parametrize("slip", [1.0, 0.9])
def test_s_curve(slip):
    states, _, finished = _drive(S_CURVE, [0.0, 0.0, 0.75], slip=slip)
    assert finished
    assert np.linalg.norm(states[-1, :2] - S_CURVE[-1]) < 0.03
    assert _lateral(states, S_CURVE).max() < 0.05


def test_corners_are_hardly_cut():
    states, _, finished = _drive(L_PATH, [0.0, 0.0, 0.0])
    assert finished and _lateral(states, L_PATH).max() < 0.05


@pytest.mark.parametrize("yaw", [0.0, 2.0, -3.0])
@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (-0.2, 0.1, 1.0), (0.0, 0.0, math.pi)])
def test_reaches_position_and_final_yaw(start, yaw):
    path = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.5]])
    states, commands, finished = _drive(path, start, final_yaw=yaw)
    assert finished
    assert np.linalg.norm(states[-1, :2] - path[-1]) < 0.045
    assert abs((states[-1, 2] - yaw + math.pi) % (2 * math.pi) - math.pi) < 0.04
    assert not commands[-1].any()


@pytest.mark.parametrize("path", [S_CURVE, L_PATH], ids=["S", "L"])
def test_speeds_and_accelerations_keep_their_bounds(path):
    config = TrackerConfig(max_speed=0.5, max_yaw_rate=0.8, max_acceleration=0.4, max_yaw_acceleration=1.5)
    _, commands, finished = _drive(path, [0.1, -0.2, 2.5], config=config, final_yaw=1.0)
    assert finished
    assert commands[:, 0].max() <= 0.5 + 1e-9 and commands[:, 0].min() >= -config.max_reverse - 1e-9
    assert np.abs(commands[:, 1]).max() <= 0.8 + 1e-9
    change = np.abs(np.diff(np.vstack([[0, 0], commands]), axis=0)) / config.period
    assert (change <= np.array([0.4, 1.5]) + 1e-6).all()


def test_turns_on_the_spot_first_when_it_faces_away():
    states, commands, finished = _drive(np.array([[0.0, 0.0], [2.0, 0.0]]), [0.0, 0.0, 3.0])
    assert finished
    turning = np.abs(states[::10, 2][: len(commands)]) > math.radians(60)
    assert np.abs(commands[turning[: len(commands)], 0]).max() == 0
    assert np.linalg.norm(states[np.abs(states[:, 2]) > 0.5, :2], axis=1).max() < 1e-6


def test_times_set_the_pace():
    path = np.stack([np.linspace(0, 2, 40), np.zeros(40)], axis=1)
    durations = []
    for duration in (8.0, 16.0):
        _, commands, finished = _drive(path, [0.0, 0.0, 0.0], times=np.linspace(0, duration, 40))
        assert finished
        durations.append(0.1 * len(commands))
    assert durations[0] == pytest.approx(8.0, rel=0.2) and durations[1] == pytest.approx(16.0, rel=0.2)


def test_crossing_paths_are_driven_in_order():
    t = np.linspace(0, 2 * np.pi, 120)
    eight = np.stack([np.sin(t), 0.7 * np.sin(2 * t)], axis=1)
    states, _, finished = _drive(eight, [0.0, 0.0, 0.9])
    assert finished and _lateral(states, eight).max() < 0.05
    length = np.linalg.norm(np.diff(eight, axis=0), axis=1).sum()
    driven = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1).sum()
    assert driven == pytest.approx(length, rel=0.05)


def test_a_path_of_one_point_and_a_path_already_driven():
    for path in (np.zeros((1, 2)), np.zeros((3, 2)), np.array([[-1.0, 0.0], [0.0, 0.0]])):
        tracker = BaseTracker()
        assert tracker.command(np.array([0.01, 0.0, 0.3]), path) == (0.0, 0.0) and tracker.finished


def test_the_controller_plans_within_accelerations_and_steers_to_the_side_of_its_target():
    controller = UnicycleMpc(10, 0.1, (-0.1, -1.0), (0.5, 1.0), accelerations=(0.6, 2.0))
    ahead = np.stack([np.linspace(0.05, 0.5, 10), np.zeros(10), np.zeros(10)])
    v, omega = controller.solve(np.zeros(3), np.zeros(2), ahead)
    assert v == pytest.approx(0.06) and omega == pytest.approx(0.0, abs=1e-9)
    for side in (1, -1):
        controller.reset()
        left = ahead + side * np.array([[0.0], [0.1], [0.0]])
        assert side * controller.solve(np.zeros(3), np.array([0.4, 0.0]), left)[1] > 0.05


def test_commands_are_quick():
    tracker, state = BaseTracker(), np.array([0.0, 0.1, 0.6])
    tracker.command(state, S_CURVE)
    started = time.perf_counter()
    for _ in range(50):
        tracker.command(state, S_CURVE)
    assert (time.perf_counter() - started) / 50 < 0.02


@pytest.mark.parametrize(
    "state, path, times, offender",
    [
        ([0.0, math.nan, 0.0], S_CURVE, None, "state must be finite"),
        ([0.0] * 3, np.zeros((0, 2)), None, "at least one position"),
        ([0.0] * 3, np.array([[0.0, math.inf]]), None, "finite"),
        ([0.0] * 3, L_PATH, np.zeros(4), "increase strictly"),
    ],
)
def test_malformed_input_is_refused(state, path, times, offender):
    with pytest.raises(TrajectoryError, match=offender):
        BaseTracker().command(np.array(state), path, times)


def test_bad_settings_are_refused():
    with pytest.raises(ConfigError, match="cruise_speed"):
        TrackerConfig(cruise_speed=2.0)


def test_every_short_path_is_driven_to_its_end_however_the_base_stands_beside_it():
    rng = np.random.default_rng(0)
    for _ in range(40):
        begin, along = rng.uniform(-0.1, 0.1, 2), rng.uniform(-math.pi, math.pi)
        path = begin + np.linspace(0, rng.uniform(0.05, 0.6), 20)[:, None] * [
            math.cos(along),
            math.sin(along),
        ]
        states, _, finished = _drive(path, [0.0, 0.0, rng.uniform(-math.pi, math.pi)])
        assert finished, f"it stands {np.linalg.norm(states[-1, :2] - path[-1]):.3f} m beside the end"
        assert np.linalg.norm(states[-1, :2] - path[-1]) < 0.045


def test_no_path_is_so_crooked_that_the_base_stands_still_on_it():
    rng = np.random.default_rng(0)
    for _ in range(12):
        along, length = rng.uniform(-math.pi, math.pi), rng.uniform(0.3, 1.2)
        path = np.linspace(0, length, 35)[:, None] * [math.cos(along), math.sin(along)]
        path = path + rng.normal(0, 0.01, path.shape)
        states, _, finished = _drive(path, [0.0, 0.0, rng.uniform(-math.pi, math.pi)])
        assert finished, f"it stands {np.linalg.norm(states[-1, :2] - path[-1]):.3f} m before the end"
        assert np.linalg.norm(states[-1, :2] - path[-1]) < 0.045
        assert _lateral(states, path).max() < 0.1


def test_a_base_that_is_held_before_the_end_does_not_cut_the_corner():
    tracker, path = BaseTracker(), np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.2]])
    state = np.array([0.1, 0.0, 0.0])
    for _ in range(20):  # something is in its way
        v, omega = tracker.command(state, path)
        tracker.overruled(0.0, 0.0)
    assert v > 0 and abs(omega) < 1.0
    assert tracker._reference.length > 0.4
