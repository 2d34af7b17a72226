"""What the completion network learns from: exact images of random rooms, and windows as the mapper makes them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from benchmarks.camera_ways import camera_way
from benchmarks.random_rooms import depth_image, random_room
from benchmarks.train_completion import Data, Train, Window, score, turned, turned_away, windows
from isdf.mapping.completion import CHANNELS, STRIDE, CompletionNet


def test_rays_end_at_the_first_surface():
    rng = np.random.default_rng(3)
    room = random_room(rng)
    _, poses = camera_way(rng, room)
    T = poses[0]
    depth = depth_image(*room.solids, T, (70.0, 70.0, 39.5, 29.5), 60, 80, 0.1, 10.0)
    v, u = np.nonzero(depth)
    assert len(v) > 0.5 * depth.size
    rays = np.stack([(u - 39.5) / 70, (v - 29.5) / 70, np.ones(len(v))], axis=1) @ T[:3, :3].T
    ends = T[:3, 3] + rays * depth[v, u, None]
    assert np.abs(room.distance(ends)).max() < 1e-5
    for share in np.linspace(0, 0.99, 20):
        assert room.distance(T[:3, 3] + share * (ends - T[:3, 3])).min() > 0


def test_truth_of_a_window_lies_between_its_bounds():
    for seed in (4, 5, 6):
        _, window = list(windows(np.random.default_rng(seed)))[-1]
        assert window.x.shape[0] == CHANNELS and all(side % STRIDE == 0 for side in window.x.shape[1:])
        free = window.mask & (window.x[2] > 0)
        upper, lower, truth = window.x[0][free], window.x[1][free], window.truth[free]
        assert free.sum() > 1000 and window.looks[free].sum() > 0.8 * window.looks.sum()
        assert ((truth > upper + 0.05) & (upper < 3)).float().mean() < 0.01
        assert (truth < lower - 0.08).float().mean() < 0.02


def test_a_camera_that_turns_looks_round_at_one_place():
    found = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        room = random_room(rng)
        kind, poses = camera_way(rng, room)
        if kind != "turn":
            continue
        found += 1
        eyes, ahead = np.array(poses)[:, :3, 3], np.array(poses)[:, :2, 2]
        heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        assert np.ptp(eyes[:, 2]) < 1e-9 and np.linalg.norm(np.ptp(eyes, axis=0)) < 1.2
        assert (np.diff(heading) > 0).all() and np.ptp(heading) > 1.2
        assert (room.distance(eyes) > 0.1).all() and room.inside(eyes).all()
    assert found > 2


def test_turning_a_window_turns_its_directions():
    _, window = next(windows(np.random.default_rng(3)))
    for seed in range(8):
        other = turned(window, np.random.default_rng(seed))
        torch.testing.assert_close(
            other.x[6:].sum((1, 2, 3)), window.x[6:].sum((1, 2, 3)), atol=0.1, rtol=1e-3
        )
        # Against the direction to the closest surface the distance to it grows.
        for axis in range(2):
            slope = other.x[0].diff(dim=axis).narrow(1 - axis, 0, 8)
            along = other.x[4 + axis].narrow(axis, 0, slope.shape[axis]).narrow(1 - axis, 0, 8)
            assert (slope * along).sum() < 0


def slope(direction, shape=(8, 8, 8)):
    """Distances of nodes from a plane across a direction (3,)."""
    places = torch.stack(torch.meshgrid(*map(torch.arange, shape), indexing="ij"), dim=-1).float()
    return 0.16 * places @ torch.tensor(direction)


def window_of(truth):
    """One in which all is known, and nothing proven but that distances are less than 2 m off the truth."""
    x, all_of_it = torch.zeros(CHANNELS, *truth.shape), torch.ones_like(truth)
    x[0], x[1] = truth + 2, truth - 2
    return Window(x, truth, all_of_it.bool(), all_of_it)


def test_gradients_are_compared_between_nodes_that_are_known():
    window = window_of(slope((1.0, 0.0, 0.0)))
    window.mask[2, 3, 4] = False
    away, known = turned_away(slope((0.6, 0.8, 0.0)), window)
    torch.testing.assert_close(away[known], torch.full_like(away[known], 0.4), atol=1e-4, rtol=0)
    assert known.sum() == 7**3 - 4 and not known[2, 3, 4] and not known[1, 3, 4] and known[3, 3, 4]


def test_of_guesses_equally_far_off_the_one_with_the_better_gradient_wins():
    window = window_of(slope((1.0, 0.0, 0.0)))
    off = torch.full(window.truth.shape, 0.05)
    wavy = off * (1 - 2 * (torch.arange(8) % 2))

    def loss(error):
        share = (2 - error) / 4
        return float(score(lambda x: (share[None], torch.full_like(share, -3.0)[None]), window)[0])

    assert (loss(off) + loss(-off)) / 2 < loss(wavy) - 0.005


@pytest.mark.parametrize("off", [0.02, 0.2])
def test_to_expect_the_error_there_is_costs_the_least(off):
    window = window_of(torch.full((8, 8, 8), 1.0))
    gap = window.x[0] - window.x[1]

    def loss(expected):
        share = torch.full_like(gap, (2 - off) / 4)
        return float(score(lambda x: (share[None], torch.log(expected / gap)[None]), window)[0])

    # Nothing is expected to err by less than a centimetre.
    for expected in (0.001, off / 8, 3 * off):
        assert loss(expected) > loss(off - 0.01) + 0.01


def test_a_network_is_trained_from_windows_on_disk(tmp_path: Path):
    Data(tmp_path / "windows", rooms=1, seed=3).run()
    begun, out = tmp_path / "begun.safetensors", tmp_path / "weights.safetensors"
    Train(tmp_path / "windows", begun, minutes=1e-9).run()
    Train(tmp_path / "windows", out, minutes=0.03, batch=1).run()
    weights, untrained = load_file(out), load_file(begun)
    CompletionNet().load_state_dict(weights)
    assert all(bool(value.isfinite().all()) for value in weights.values())
    assert any(not value.equal(untrained[name]) for name, value in weights.items())
    Train(tmp_path / "windows", out, start=out, judge=True).run()


def test_what_is_written_keeps_a_share_of_what_training_began_from(tmp_path: Path):
    torch.manual_seed(1)
    begun, trained = CompletionNet(), CompletionNet()
    start, out = tmp_path / "start.safetensors", tmp_path / "out.safetensors"
    Train(tmp_path, start).save(begun)
    Train(tmp_path, out, start=start, keep=0.25).save(trained)
    written, b, t = load_file(out), begun.state_dict(), trained.state_dict()
    for name, value in written.items():
        torch.testing.assert_close(value.float(), 0.25 * b[name] + 0.75 * t[name], atol=1e-3, rtol=1e-3)
    for options in ({"keep": 0.5}, {"keep": 1.0, "start": start}, {"keep": 0.5, "start": out}):
        with pytest.raises(SystemExit, match="keep"):
            Train(tmp_path, out, **options)
