"""The default map: exact where seen, between proven bounds elsewhere, honest about it, and hard to upset."""

import json
import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from isdf import (
    CheckpointError,
    ConfigError,
    DepthFrame,
    FrameError,
    Mapper,
    MapperConfig,
    NotReadyError,
    PinholeCamera,
)
from isdf.cli import main
from isdf.datasets import SequenceWriter
from isdf.evaluation import roc_area
from isdf.mapping import refresh
from isdf.mapping.bricks import BrickVolume
from isdf.mapping.completion import CHANNELS, load_network
from isdf.mapping.evidence import gather
from isdf.mapping.fusion import fuse
from isdf.mapping.nearest import nearest_points
from isdf.mapping.seeds import ENDED, surface_seeds
from isdf.methods import load_map
from tests.gradients import assert_gradient_matches
from tests.isdf.rooms import box, furnished_orbit, furnished_room, look_at, mapped, render, union

CAMERA = PinholeCamera.from_fov(80, 60, math.radians(70))


@pytest.fixture(scope="module")
def orbit():
    return mapped(furnished_orbit(16))


def visible_points(frames, count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = []
    for frame in frames:
        surface = frame.thinned(1, 10.0)
        surface = surface[torch.randint(len(surface), (count,), generator=generator)]
        eye = frame.T_world_camera[:3, 3].float()
        points.append(eye + torch.rand(count, 1, generator=generator) * (surface - eye))
    return torch.cat(points)


def room_points(count=4000):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(3)) * torch.tensor(
        [5, 4, 2.5]
    ) - torch.tensor([2.5, 2.0, 0.0])


def test_it_is_exact_where_the_camera_looked_and_knows_where_that_was(orbit):
    field, sdf = orbit.field(), furnished_room()
    seen = visible_points(furnished_orbit(16), 200)
    error = field.distance(seen) - sdf(seen)
    sure = field.confidence(seen) > 0.95
    assert sure.float().mean() > 0.12
    assert error[sure].abs().mean() < 0.0055
    assert error[sure].abs().mean() < 0.15 * error[~sure].abs().mean()
    assert error.abs().mean() < 0.027
    many = visible_points(furnished_orbit(16), 4000)  # of a few thousand points the share is chance
    assert (field.distance(many) - sdf(many) > 0.05).float().mean() < 0.05
    everywhere = torch.cat([seen, room_points()])
    everywhere = everywhere[sdf(everywhere) > 0]
    assert roc_area(field.confidence(everywhere), field.distance(everywhere) - sdf(everywhere)) > 0.87
    assert field.confidence(seen).mean() > 0.63
    assert field.confidence(torch.tensor([[0.0, 0.0, 30.0]])) == 0


def test_guesses_beat_the_distance_to_what_was_seen():
    mapper, sdf = Mapper(), furnished_room()
    for frame in furnished_orbit(16)[:2]:
        mapper.integrate(frame)
    seeds = surface_seeds(mapper.bricks.arrays, *mapper.bricks.box(np.full(3, -9.0), np.full(3, 9.0)))[:, :3]
    points = room_points()
    points = points[sdf(points) > 0]
    upper = torch.from_numpy(cKDTree(seeds).query(points.numpy())[0]).float()
    field = mapper.field()
    assert (field.distance(points) - sdf(points)).abs().mean() < 0.18 * (upper - sdf(points)).abs().mean()


@pytest.mark.parametrize(
    ("eye", "spacing", "middle"),
    [
        ((1.4, 0.0, 1.2), 0.16, (1.4, 0.0, 1.2)),
        ((2.5, 0.0, 1.2), 0.16, (-3.0 + 28 * 0.16, 0.0, 1.2)),
        ((-2.5, 19.0, 1.2), 0.16, (3.0 - 28 * 0.16, 20.0 - 28 * 0.16, 1.2)),
        ((2.5, -19.0, 1.2), 0.08, (3.0 - 28 * 0.08, -20.0 + 28 * 0.08, 1.2)),
    ],
)
@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1)])
def test_guesses_are_made_about_the_camera_but_where_something_was_seen(eye, spacing, middle, axes):
    bounds, up = np.array([[-3.0, -20.0, 0.0], [3.0, 20.0, 3.0]]), np.array([0.0, 0.1, -0.9])
    turned = [np.array(a)[..., axes] for a in (eye, up, bounds, middle)]
    np.testing.assert_allclose(refresh.middle_of_guesses(*turned[:3], spacing), turned[3], atol=1e-12)


def test_a_room_is_guessed_as_a_whole_from_its_corner(monkeypatch):
    middles, mapper = [], Mapper(MapperConfig(guess_period=0.0))

    def guess(lattice, bricks, network, middle, up):
        middles.append(middle)
        return refresh.guess(lattice, bricks, network, middle, up)

    monkeypatch.setattr("isdf.mapping.mapper.guess", guess)
    monkeypatch.setattr(refresh, "GUESS_ACROSS", 1.6)
    away = []
    for frame in furnished_orbit(16)[:8]:
        mapper.integrate(frame)
        low, high = mapper.bounds.numpy()[:, :2]
        below, above = low - (middles[-1][:2] - 1.6), middles[-1][:2] + 1.6 - high
        assert (((below > -1e-4) & (above > -1e-4)) | ((below < 1e-4) & (above < 1e-4))).all()
        away.append(np.abs(middles[-1][:2] - frame.T_world_camera.numpy()[:2, 3]).max())
        assert middles[-1][2] == frame.T_world_camera[2, 3]
    assert len(middles) == 8 and max(away) > 0.3


def moments(mapper, times, monkeypatch):
    """At which of these times [s] the network ran, and at which distances were refreshed."""
    guessed, refreshed = [], []
    for name, kept in (("guess", guessed), ("refresh", refreshed)):
        real = getattr(refresh, name)

        def noted(*arguments, real=real, kept=kept):
            kept.append(now)
            return real(*arguments)

        monkeypatch.setattr(f"isdf.mapping.mapper.{name}", noted)
    for now, frame in zip(times, furnished_orbit(16) * 4, strict=False):
        noisy = frame.depth + 1e-4 * torch.rand(frame.depth.shape)  # no image twice
        mapper.integrate(replace(frame, depth=noisy, time=now))
    return guessed, refreshed


def test_no_frame_waits_for_the_network_with_those_that_wait_for_a_refresh(monkeypatch):
    """The network runs soon after a refresh, long before the next one."""
    guessed, refreshed = moments(Mapper(), [0.0625 * n for n in range(64)], monkeypatch)
    assert guessed[0] == refreshed[0] == 0
    assert len(guessed) >= 4 and not set(guessed[1:]) & set(refreshed)
    for when in guessed[1:]:
        assert when - max(r for r in refreshed if r < when) <= 0.125
    assert all(1 <= gap <= 1.25 for gap in np.diff(guessed))
    assert all(gap == 0.25 for gap in np.diff(refreshed))


def test_of_frames_that_come_seldom_none_goes_without_the_network(monkeypatch):
    times = [1.1 * n for n in range(5)]
    assert moments(Mapper(), times, monkeypatch) == (times, times)


def test_truth_lies_between_the_bounds(orbit):
    lattice, bricks = orbit.lattice, orbit.bricks
    seeds = surface_seeds(bricks.arrays, *bricks.box(np.full(3, -9.0), np.full(3, 9.0)))[:, :3]
    evidence = lattice.read("evidence", np.zeros(3, dtype=int), np.array(lattice.shape))
    proven = gather(seeds, evidence, lattice.corner, lattice.spacing)
    nodes = lattice.spacing * (lattice.corner + np.argwhere(np.ones(lattice.shape, dtype=bool)))
    inside = (np.abs(nodes) < [2.5, 2.0, 9]).all(axis=1) & (nodes[:, 2] > 0) & (nodes[:, 2] < 2.5)
    truth = furnished_room()(torch.from_numpy(nodes)).numpy()[inside]
    assert (truth > proven.upper.ravel()[inside] + 0.05).mean() < 0.007
    free = proven.free.ravel()[inside]
    assert free.any()
    assert (truth[free] < proven.lower.ravel()[inside][free] - 0.08).mean() < 0.02


def test_sweeps_find_the_nearest_points():
    points = (np.random.default_rng(0).random((300, 3)) * [20, 16, 12]).astype(np.float32)
    _, square = nearest_points(points, np.ones((20, 16, 12), dtype=bool))
    nodes = np.argwhere(np.ones((20, 16, 12), dtype=bool))
    exact = cKDTree(points).query(nodes)[0]
    assert (np.sqrt(square).ravel() >= exact - 1e-4).all()
    assert (np.sqrt(square).ravel() - exact).mean() < 1e-6


def test_sweeps_hardly_ever_miss_the_nearest_point():
    nodes, over = np.argwhere(np.ones((20, 16, 12), dtype=bool)), []
    for seed in range(10):
        points = (np.random.default_rng(seed).random((300, 3)) * [20, 16, 12]).astype(np.float32)
        _, square = nearest_points(points, np.ones((20, 16, 12), dtype=bool))
        over.append(np.sqrt(square).ravel() - cKDTree(points).query(nodes)[0])
    assert np.mean(over) < 1e-4 and np.mean(np.array(over) > 1e-4) < 1e-3


def test_gradient_is_that_of_the_interpolant(orbit):
    field = orbit.field()
    points = room_points(60).double()
    spacing = 0.25 * field.spacing
    points = (torch.floor(points / spacing) + 0.5) * spacing  # away from where pieces meet, but for ridges
    steps = 2e-3 * torch.cat([torch.eye(3), -torch.eye(3)]).double()
    around = torch.stack([field.distance_and_gradient(points + step)[1] for step in steps])
    smooth = (around - field.distance_and_gradient(points)[1]).norm(dim=-1).amax(dim=0) < 0.1
    assert smooth.sum() > 40
    points = points[smooth]
    assert_gradient_matches(
        lambda p: field.distance(p).sum(),
        lambda p: field.distance_and_gradient(p)[1],
        points, step=2e-3, rtol=0.02, atol=0.02,
    )  # fmt: skip
    points.requires_grad_(True)
    field.distance(points).sum().backward()
    torch.testing.assert_close(points.grad, field.distance_and_gradient(points.detach())[1])


def test_queries_of_any_shape_and_number_of_threads_agree(orbit):
    field, points = orbit.field(), room_points(40_000)
    distance, gradient = field.distance_and_gradient(points.view(200, 200, 3))
    assert distance.shape == (200, 200) and gradient.shape == (200, 200, 3)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        torch.testing.assert_close(field.distance(points), distance.view(-1))
    finally:
        torch.set_num_threads(before)
    assert field.distance(torch.zeros(0, 3)).shape == (0,)
    assert field.distance(torch.tensor([[torch.nan, 0, 0]])).isnan().all()
    assert torch.isfinite(field.distance(torch.tensor([[1e6, -1e6, 1e6]]))).all()


def test_a_baked_field_is_close_to_the_field(orbit):
    field, points = orbit.field(), visible_points(furnished_orbit(16), 50)
    baked = field.bake(0.04)
    assert (baked.distance(points) - field.distance(points)).abs().mean() < 0.001


def test_snapshots_do_not_change_and_saved_maps_go_on_alike(tmp_path):
    frames = furnished_orbit(16)
    mapper = Mapper()
    for frame in frames[:6]:
        mapper.integrate(frame)
    mapper.save(tmp_path / "map.safetensors")
    snapshot, points = mapper.field(), room_points()
    before = snapshot.distance(points)
    again = load_map(tmp_path / "map.safetensors")
    assert isinstance(again, Mapper)
    torch.testing.assert_close(again.field().distance(points), before)
    for frame in frames[6:9]:
        mapper.integrate(frame)
        again.integrate(frame)
    assert torch.equal(snapshot.distance(points), before)
    assert not torch.equal(mapper.field().distance(points), before)
    difference = (again.field().distance(points) - mapper.field().distance(points)).abs()
    assert difference.mean() < 1e-3  # fused distances are saved in half precision


def test_damaged_files_are_refused(tmp_path, orbit):
    path = tmp_path / "map.safetensors"
    orbit.save(path)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(CheckpointError, match="map"):
        Mapper.load(path)


def scene(*extra):
    return union(furnished_room(), *extra)


def watch(mapper, sdf, start, seconds, fps=10):
    """Look at the middle of the room for a while."""
    for n in range(round(seconds * fps)):
        eye = (-1.6 + 0.02 * (n % 3), -1.5, 1.3)
        frame = render(sdf, look_at(eye, (0.3, 0.2, 0.5)), CAMERA, start + n / fps)
        mapper.integrate(frame)
    return start + seconds


def test_what_moves_goes_and_comes_within_two_seconds_of_being_looked_at():
    obstacle, other = box((0.2, -0.7, 0.3), (0.4, 0.4, 0.6)), box((-0.2, 0.6, 0.35), (0.4, 0.4, 0.7))
    mapper = Mapper()
    now = watch(mapper, scene(obstacle), 0.0, 2.0)
    near = torch.tensor([0.08, -0.82, 0.5]) + 0.16 * (
        torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    )
    assert (mapper.field().distance(near) - scene(obstacle)(near)).abs().mean() < 0.036
    frame = render(scene(other), look_at((-1.6, -1.5, 1.3), (0.3, 0.2, 0.5)), CAMERA)
    rest = visible_points([frame], 2000)
    rest = rest[(scene(obstacle)(rest) - scene(other)(rest)).abs() < 1e-3]
    before = (mapper.field().distance(rest) - scene(obstacle)(rest)).abs().mean()
    now = watch(mapper, scene(other), now, 2.0)
    field, truth, never = mapper.field(), scene(other), Mapper()
    watch(never, scene(other), 0.0, 2.0)
    gone = (field.distance(near) - never.field().distance(near)).abs()
    assert gone.mean() < 0.02  # as if it had never been there
    front = torch.tensor([-0.3, 0.5, 0.5]) + 0.1 * (
        torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    )
    assert (field.distance(front) < 0).float().mean() > 0.95
    assert (field.distance(rest) - truth(rest)).abs().mean() < 1.1 * before


def test_a_jump_of_the_pose_is_passed_over_and_said_so(caplog):
    mapper, sdf = Mapper(), furnished_room()
    now = watch(mapper, sdf, 0.0, 1.0)
    points = room_points()
    mapper.refresh()
    before = mapper.field().distance(points)
    frame = render(sdf, look_at((-1.63, -1.5, 1.3), (0.3, 0.2, 0.5)), CAMERA, now)
    T = frame.T_world_camera.clone()
    T[:3, 3] += torch.tensor([0.1, 0.1, 0.27])
    with caplog.at_level(logging.WARNING):
        mapper.integrate(DepthFrame(frame.depth, T, CAMERA, now))
    assert "contradict" in caplog.text and mapper.frames_skipped == 1
    mapper.refresh()
    assert torch.equal(mapper.field().distance(points), before)
    mapper.integrate(DepthFrame(frame.depth + 1e-3, frame.T_world_camera, CAMERA, now))
    assert mapper.frames_seen == 11
    for n in range(8):  # but a jump that lasts is believed
        mapper.integrate(DepthFrame(frame.depth + 1e-4 * (n + 1), T, CAMERA, now + 0.1 * n))
    assert mapper.frames_skipped < 8


def test_a_hanging_camera_does_no_harm_and_is_said_so(caplog):
    mapper, sdf = Mapper(), furnished_room()
    watch(mapper, sdf, 0.0, 0.5)
    frame = render(sdf, look_at((-1.6, -1.5, 1.3), (0.3, 0.2, 0.5)), CAMERA, 0.6)
    with caplog.at_level(logging.WARNING):
        for n in range(5):
            mapper.integrate(replace_time(frame, 0.6 + 0.1 * n))
        mapper.integrate(furnished_orbit(16)[0])
    assert caplog.text.count("hangs") == 1 and "is back" in caplog.text
    assert mapper.frames_skipped == 4
    assert torch.isfinite(mapper.field().distance(room_points())).all()


def replace_time(frame, time):
    return DepthFrame(frame.depth, frame.T_world_camera, frame.camera, time)


def test_bad_input_is_refused_by_name():
    with pytest.raises(NotReadyError, match="integrate"):
        Mapper().field()
    with pytest.raises(NotReadyError, match="integrate"):
        _ = Mapper().bounds
    with pytest.raises(ConfigError, match="voxel"):
        MapperConfig(voxel=-1.0)
    with pytest.raises(ConfigError, match="truncation"):
        replace(MapperConfig(), truncation=0.04)
    far = DepthFrame(torch.full((60, 80), 20.0), torch.eye(4), CAMERA)
    with pytest.raises(FrameError, match="max_depth"):
        Mapper().integrate(far)


def test_the_network_can_only_share_out_the_gap():
    share, width = load_network()(torch.randn(1, CHANNELS, 16, 16, 8))
    assert share.shape == width.shape == (1, 16, 16, 8)
    assert bool(((share >= 0) & (share <= 1)).all()) and torch.isfinite(width).all()


def test_the_network_of_a_fine_map_sees_no_more_nodes(monkeypatch):
    """A voxel four times as fine would else take it 64 times the memory."""
    nodes = []
    run = refresh._run
    monkeypatch.setattr(refresh, "_run", lambda network, x: nodes.append(x[0].numel()) or run(network, x))
    for voxel in (0.02, 0.01, 0.005):
        mapper = Mapper(MapperConfig(voxel=voxel))
        mapper.integrate(furnished_orbit(16)[0])
    assert len(nodes) >= 3 and max(nodes) <= 57 * 57 * 33, nodes


def test_turned_worlds_give_the_same_map():
    sdf, points = furnished_room(), room_points(2000)
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # y up becomes -z down
    fields = []
    for R in (torch.eye(3), turn):
        mapper = Mapper()
        for frame in furnished_orbit(16)[:4]:
            T = frame.T_world_camera.clone()
            T[:3] = R.double() @ T[:3]
            mapper.integrate(DepthFrame(frame.depth, T, frame.camera, frame.time))
        mapper.refresh()
        fields.append(mapper.field().distance(points @ R.T))
    assert (fields[0] - fields[1]).abs().mean() < 0.006
    assert sdf(points).abs().mean() > 0.2


def test_the_command_line_maps_with_it_by_default(tmp_path, monkeypatch):
    frames = furnished_orbit(16)
    writer = SequenceWriter(tmp_path / "seq", frames[0].camera, fps=10.0)
    for frame in frames[:8]:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    monkeypatch.setattr("sys.argv", ["isdf", "map", str(tmp_path / "seq"), "--out", str(tmp_path / "run")])
    main()
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["method"] == "default" and report["frames_used"] >= 1
    np.save(tmp_path / "points.npy", room_points(100).numpy())
    monkeypatch.setattr(
        "sys.argv",
        ["isdf", "query", str(tmp_path / "run"),
         "--points", str(tmp_path / "points.npy"), "--out", str(tmp_path / "a.npz")],
    )  # fmt: skip
    main()
    answer = np.load(tmp_path / "a.npz")
    assert set(answer.files) == {"distance", "gradient", "confidence"}
    assert (
        np.isfinite(answer["distance"]).all()
        and ((answer["confidence"] >= 0) & (answer["confidence"] <= 1)).all()
    )


def test_what_one_pixel_sees_through_a_crack_has_its_place_in_the_map():
    """Its bricks lie outside of the box of every other pixel's view, however few pixels are looked at."""
    camera = PinholeCamera(144.0, 144.0, 79.5, 59.5, 160, 120)
    for row, column in ((61, 3), (61, 157), (1, 81), (119, 81)):
        mapper, depth = Mapper(), torch.full((120, 160), 1.0)
        depth[40:44, 60:64], depth[row, column] = 9.0, 8.0
        mapper.integrate(DepthFrame(depth, torch.eye(4), camera))
        bricks = mapper.bricks
        ray = np.array([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0])
        places = np.linspace(7.95, 8.05, 9)[:, None] * ray
        index = np.floor(places / (8 * bricks.voxel)).astype(int) - bricks.corner
        assert (index >= 0).all() and (index < bricks.table.shape).all(), (row, column)
        assert (bricks.table[tuple(index.T)] >= 0).any(), (row, column)


def test_four_views_through_it_are_enough_for_what_has_gone():
    obstacle, mapper = box((-0.6, -0.9, 1.0), (0.3, 0.3, 0.5)), Mapper()  # hangs in mid-air, in full view
    now = watch(mapper, scene(obstacle), 0.0, 2.0)
    inside = torch.tensor([-0.6, -0.9, 1.0]) + 0.25 * (
        torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    )
    assert mapper.field().distance(inside).mean() < 0.1
    watch(mapper, scene(), now, 1.0, fps=4)
    mapper.refresh()
    assert (mapper.field().distance(inside) - scene()(inside)).abs().mean() < 0.1


def test_it_knows_what_was_looked_through():
    mapper = Mapper()
    watch(mapper, scene(), 0.0, 1.0)
    field = mapper.field()
    places = torch.tensor(
        [[-1.0, -1.0, 1.0], [0.0, 0.0, 0.6], [-1.6, -1.5, 2.3], [-1.6, -2.4, 0.5], [0.0, 0.0, 30.0]]
    )
    assert field.observed(places).tolist() == [True, True, False, False, False]
    assert torch.equal(field.observed(places.view(1, 5, 3)), field.observed(places)[None])
    assert field.observed(places.double()).dtype == torch.bool
    mapper.integrate(render(scene(), look_at((-1.6, -1.5, 1.3), (-1.5, -1.5, 3.0)), CAMERA, 2.5))
    assert mapper.field().observed(places).tolist() == [True, True, True, False, False]
    assert field.observed(places).tolist() == [True, True, False, False, False], "a snapshot does not change"


def test_an_image_with_one_pixel_left_is_no_error_wherever_that_is():
    camera, depth = PinholeCamera.from_fov(320, 240, math.radians(60)), torch.zeros(240, 320)
    depth[101, 203] = 1.0
    mapper = Mapper()
    mapper.integrate(DepthFrame(depth, torch.eye(4), camera))
    assert mapper.frames_seen == 1


def fused_wall():
    """A brick before and behind a wall at z = 0.08 m, which a camera at z = -1 m looks at."""
    bricks = BrickVolume(0.02, 1_000)
    bricks.include(np.zeros(3), np.full(3, 0.1))
    bricks.add(-bricks.corner[None])
    depth = np.full((60, 80), 1.08, dtype=np.float32)
    pose = np.eye(4)
    pose[2, 3] = 1.0
    intrinsics = (80.0, 80.0, 39.5, 29.5)
    shape = np.array(bricks.table.shape)
    fuse(bricks.arrays, 0 * shape, shape, depth, depth, 0.012, 0.1, 20.0, intrinsics, pose)
    return bricks


def test_a_view_is_evidence_of_a_surface_where_it_ends():
    ended = fused_wall().ended[0].reshape(8, 8, 8)
    assert (ended[..., 4] == 1).all()  # at the wall
    assert (ended[..., :3] == 0).all()  # seen through
    assert (ended[..., 6:] == 0).all()  # hidden


def test_no_surface_is_where_few_views_end():
    """Where space hidden behind an edge borders on space seen through the fused distances cross zero, too."""
    bricks = fused_wall()
    bricks.ended[0].reshape(8, 8, 8)[:4] = 0.9 * ENDED
    seeds = surface_seeds(bricks.arrays, *bricks.box(np.zeros(3), np.full(3, 0.1)))
    assert len(seeds) > 0 and (seeds[:, 0] > 0.07).all()
    np.testing.assert_allclose(seeds[:, 2], 0.08, atol=1e-4)


def test_images_that_follow_closely_are_passed_over_unless_the_clock_stands_still():
    fused = []
    for times in ((0.0, 0.033, 0.067, 0.1), (0.0, 0.0, 0.0, 0.0), (3.0, 2.0, 1.0, 0.0)):
        mapper = Mapper()
        for frame, time in zip(furnished_orbit(16), times, strict=False):
            before = mapper.bricks.weight.sum()
            mapper.integrate(replace_time(frame, time))
            fused.append(bool(mapper.bricks.weight.sum() > before))
        assert mapper.frames_seen == 4 and mapper.frames_skipped == 0
    assert fused == [True, False, True, False] + 8 * [True]


def test_flat_surfaces_are_averaged_and_edges_stay_sharp():
    bricks = fused_wall()
    discs = surface_seeds(bricks.arrays, *bricks.box(np.zeros(3), np.full(3, 0.1)))
    np.testing.assert_allclose(discs[:, 7], 2 * 0.45 * 0.02)  # four voxels in one
    np.testing.assert_allclose(discs[:, 3:6], [[0, 0, -1]] * len(discs), atol=1e-3)
    x = 0.02 * np.arange(8)
    roof = np.maximum(0.07 - x[None, None, :], 0.07 - x[None, :, None]) + 0 * x[:, None, None]
    bricks.distance[0], bricks.ended[0] = roof.ravel(), 1.0
    discs = surface_seeds(bricks.arrays, *bricks.box(np.zeros(3), np.full(3, 0.1)))
    wide = discs[:, 7] > 0.015
    edge = np.hypot(discs[:, 1] - 0.07, discs[:, 2] - 0.07) < 0.015
    assert wide.any() and edge.any() and not wide[edge].any()
    assert (np.abs(discs[wide, 3:6]).max(axis=1) > 0.99).all()


def test_it_is_solid_behind_a_surface_farther_than_distances_are_fused(orbit):
    points = torch.tensor([[x, -2.08, z] for x in (0.32, 0.64, 0.96) for z in (0.8, 0.96, 1.12)])
    assert orbit.config.truncation < 0.07
    torch.testing.assert_close(orbit.field().distance(points), torch.full((9,), -0.08), atol=0.02, rtol=0)


def test_fusing_is_what_every_voxel_by_itself_would_be_given():
    """Whole bricks are passed over that are out of view or hidden: none of them may have had anything to gain."""
    rng = np.random.default_rng(0)
    bricks = BrickVolume(0.02, 100_000)
    bricks.include(np.full(3, -0.6), np.full(3, 0.6))
    bricks.add(np.argwhere(bricks.table < 0))
    shape = np.array(bricks.table.shape)
    depth = rng.uniform(0.6, 1.6, (6, 8)).repeat(10, 0).repeat(10, 1).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    intrinsics = (70.0, 60.0, 41.0, 27.0)
    inverse = np.linalg.inv(look_at(torch.tensor([0.9, -0.8, 0.3]), torch.zeros(3)))
    fuse(bricks.arrays, 0 * shape, shape, depth, depth, 0.012, 0.06, 20.0, intrinsics, inverse)
    for place in np.argwhere(bricks.table >= 0):
        voxels = 8 * (bricks.corner + place) + np.argwhere(np.ones((8, 8, 8)))
        x, y, z = inverse[:3, :3] @ (0.02 * voxels.T) + inverse[:3, 3:]
        front = np.maximum(z, 0.05)
        u, v = (np.floor(c).astype(int) for c in (70 * x / front + 41.5, 60 * y / front + 27.5))
        seen = (z >= 0.05) & (u >= 0) & (v >= 0) & (u < 80) & (v < 60)
        measured = np.where(seen, depth[np.clip(v, 0, 59), np.clip(u, 0, 79)], 0)
        band = np.maximum(0.06, 0.012 * measured**2)
        ahead = measured - z
        expected = (measured > 0) & (ahead > -band)
        row = bricks.table[tuple(place)]
        sure = np.abs(ahead + band) > 1e-4
        near_rim = (
            np.minimum(np.abs(70 * x / front + 41.5 - u - 0.5), np.abs(60 * y / front + 27.5 - v - 0.5))
            > 0.49
        )
        sure &= ~near_rim
        assert np.array_equal(bricks.weight[row][sure] > 0, expected[sure])
        both = sure & expected
        np.testing.assert_allclose(bricks.distance[row][both], np.minimum(ahead, band)[both], atol=1e-5)


def test_space_that_the_robot_fills_is_free_though_it_was_never_seen():
    mapper = Mapper()
    centres, radii = torch.tensor([[-1.6, -1.5, 0.2 * n] for n in range(1, 6)]).numpy(), np.full(5, 0.2)
    mapper.clear_footprint(centres, radii)  # nothing to tell yet
    watch(mapper, furnished_room(), 0.0, 1.0)
    inside = torch.from_numpy(centres).float()
    hidden = mapper.field()
    mapper.clear_footprint(centres, radii)
    mapper.refresh()
    field = mapper.field()
    assert not hidden.observed(inside).all() and field.observed(inside).all()
    assert float(field.distance(inside).min()) > max(0.0, float(hidden.distance(inside).min()))
    mapper.clear_footprint(centres + 100.0, radii)  # outside the map there is nothing to tell
    far = inside + torch.tensor([0.0, 3.0, 0.0])
    assert torch.equal(field.distance(far), hidden.distance(far))


@pytest.mark.parametrize(("centre", "radius"), [(np.nan, 1.0), (0.0, np.inf), (0.0, -0.1)])
def test_footprints_that_are_none_are_refused(centre, radius):
    mapper = Mapper()
    watch(mapper, furnished_room(), 0.0, 0.2)
    with pytest.raises(FrameError, match="clear_footprint needs finite centres"):
        mapper.clear_footprint(np.full((1, 3), centre), np.full(1, radius))
