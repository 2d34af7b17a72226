"""The voxel maps: right in a known room, honest about the unseen, growing, and the same after a save."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from isdf import (
    CheckpointError,
    ConfigError,
    DepthFrame,
    FrameError,
    IsdfMapper,
    NotReadyError,
    PinholeCamera,
    query,
)
from isdf.cli import main
from isdf.datasets import RecordedSequence, SequenceWriter
from isdf.meshing import zero_level_mesh
from isdf.methods import load_map
from isdf.runner import run_at_rate
from isdf.slices import draw_slice
from isdf.voxel import (
    ExactConfig,
    ExactMapper,
    FiestaConfig,
    FiestaMapper,
    KinectFusionConfig,
    KinectFusionMapper,
    TsdfConfig,
    TsdfVolume,
    VoxbloxConfig,
    VoxbloxMapper,
)
from isdf.voxel.nearest_seed import observed_at
from isdf.voxel.surface import surface_seeds
from tests.isdf.rooms import furnished_orbit, furnished_room, look_at, render

MAPPERS = {
    "exact": ExactMapper,
    "voxblox": VoxbloxMapper,
    "fiesta": FiestaMapper,
    "kinectfusion": KinectFusionMapper,
}
# Share of the visible points that 12 views must map: the rivals drop rays, FIESTA at the first voxel met twice.
COVERAGE = {"exact": 0.95, "voxblox": 0.95, "fiesta": 0.6, "kinectfusion": 0.95}
every_method = pytest.mark.parametrize("method", MAPPERS)


def mapped(method: str, frames: int = 12, **changes):
    mapper = MAPPERS[method]()
    mapper = MAPPERS[method](replace(mapper.config, **changes))
    for frame in furnished_orbit(12, 160)[:frames]:
        mapper.integrate(frame)
    mapper.refresh()
    return mapper


@pytest.fixture(scope="module")
def rooms():
    return {method: mapped(method) for method in MAPPERS}


def visible_points(count: int = 12000) -> torch.Tensor:
    """Depth uniform in [0.1, D] on rays through random pixels."""
    generator, points = torch.Generator().manual_seed(9), []
    for frame in furnished_orbit(12, 160):
        surface = frame.thinned(1, 12.0)
        chosen = surface[torch.randint(len(surface), (count // 12,), generator=generator)]
        arm = chosen - frame.T_world_camera[:3, 3].float()
        length = arm.norm(dim=-1, keepdim=True)
        along = 0.1 + torch.rand(len(arm), 1, generator=generator) * (length - 0.1)
        points.append(chosen + arm * (along / length - 1))
    return torch.cat(points)


@pytest.mark.parametrize(
    ("method", "mean", "near", "cosine"),
    [
        ("exact", 0.025, 0.015, 0.08),
        ("voxblox", 0.07, 0.03, 0.2),
        ("fiesta", 0.06, 0.08, 0.2),
        ("kinectfusion", 0.06, 0.08, 0.15),
    ],
)
def test_the_visible_room_is_measured(rooms, method, mean, near, cosine) -> None:
    points = visible_points()
    exact = points.clone().requires_grad_(True)
    truth = furnished_room()(exact)
    (normal,) = torch.autograd.grad(truth.sum(), exact)
    truth = truth.detach()
    field = rooms[method].field()
    distance, gradient = field.distance_and_gradient(points)
    error = (distance - truth).abs()
    assert error.mean() < mean, f"{100 * error.mean():.2f} cm"
    assert error[truth < 0.1].mean() < near
    assert (1 - torch.cosine_similarity(gradient, normal, dim=-1)).mean() < cosine
    assert (distance[truth > 0.1] > 0).float().mean() > 0.999
    # The rest lies beyond the middle of the outermost rays' voxels.
    assert field.confidence(points).mean() > COVERAGE[method]


@every_method
def test_signs_change_at_the_walls(rooms, method) -> None:
    inside = torch.tensor([[0.0, 0.0, 1.2], [0.5, -1.0, 1.0], [2.3, 0.0, 1.2], [0.0, 1.8, 1.5]])
    behind = torch.tensor([[2.55, -1.0, 1.0], [0.0, 2.05, 1.0], [-1.0, -2.05, 1.0]])
    field = rooms[method].field()
    assert bool((field.distance(inside) > 0).all()) and bool((field.distance(behind) < 0).all())


@every_method
def test_the_unseen_has_no_confidence(rooms, method) -> None:
    unseen = torch.tensor(
        [[0.0, 0.0, 5.0], [9.0, 0.0, 1.0], [-2.0, 1.2, 0.9], [0.0, 2.6, 1.2], [math.nan, 0, 1]]
    )
    seen = visible_points(480)
    field = rooms[method].field()
    assert field.confidence(unseen).tolist() == [0.0] * 5
    assert field.confidence(seen).mean() > COVERAGE[method]
    assert np.array_equal(query(field, seen.numpy())["confidence"], field.confidence(seen).numpy())
    # Nobody is told that the unseen is infinitely far away, or nothing at all.
    assert bool((field.distance(unseen[:4]).abs() < 8.0).all())


def test_outside_the_volume_nothing_was_observed() -> None:
    """Also beside a corner that was."""
    points = torch.tensor(
        [[1.0, 1.0, 1.0], [1.04, 1.0, 0.96], [1.3, 1.0, 1.0], [0.9, 1.0, 1.0], [0.0, 0.0, 0.0]]
    )
    observed = observed_at(torch.ones(3, 3, 3, dtype=torch.bool), torch.ones(3), 0.1, points)
    assert observed.tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]


@every_method
def test_any_batch_and_precision_and_autograd(rooms, method) -> None:
    field, points = rooms[method].field(), visible_points(48).double().view(2, -1, 3)
    distance, gradient = field.distance_and_gradient(points)
    assert distance.dtype == torch.float64 and gradient.shape == points.shape
    assert field.distance(points[0, 0]).shape == () and field.distance(points[:0]).shape == (
        0,
        points.shape[1],
    )
    leaf = points.clone().requires_grad_(True)
    field.distance(leaf).sum().backward()
    torch.testing.assert_close(leaf.grad, gradient)


def test_distances_are_to_the_nearest_of_all_seeds_and_not_interpolated() -> None:
    mapper = mapped("exact", patch=0.0)
    seeds = surface_seeds(mapper.volume)
    positions = torch.from_numpy(seeds.position * mapper.volume.voxel + mapper.volume.origin).float()
    points = visible_points(1200)
    least = torch.stack([(positions - point).norm(dim=1).amin() for point in points])
    distance = mapper.field().distance(points).abs()
    assert bool((distance >= least - 1e-5).all())
    assert (distance - least).mean() < 1e-3 and (distance - least).max() < 0.5 * mapper.volume.voxel


def test_seeds_lie_on_the_surface_within_a_fraction_of_a_voxel(rooms) -> None:
    volume = rooms["exact"].volume
    seeds = surface_seeds(volume)
    positions = torch.from_numpy(seeds.position * volume.voxel + volume.origin).requires_grad_(True)
    gap = furnished_room()(positions)
    assert gap.abs().median() < 0.003
    (normal,) = torch.autograd.grad(gap.sum(), positions)
    assert (
        torch.cosine_similarity(normal.float(), torch.from_numpy(seeds.normal).float(), dim=-1).median()
        > 0.99
    )
    assert len(np.unique(seeds.voxel)) == len(seeds.voxel)


def test_the_gradient_is_the_slope_of_the_distance(rooms) -> None:
    """Away from the ridges where the nearest seed changes, and where float32 resolves the differences."""
    field = rooms["exact"].field()
    points = visible_points(240).double()
    distance, gradient = field.distance_and_gradient(points)
    step = 1e-3 * gradient
    rise = field.distance(points + step) - field.distance(points - step)
    smooth = (rise / 2e-3 - 1).abs() < 0.02
    assert smooth.float().mean() > 0.95
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones_like(distance))


@every_method
def test_bad_pixels_teach_nothing(method) -> None:
    clean, dirty = mapped(method, frames=0), mapped(method, frames=0)
    for frame in furnished_orbit(12, 160)[:3]:
        depth = frame.depth.clone()
        depth[20:60, 30:90] = 0
        clean.integrate(DepthFrame(depth, frame.T_world_camera, frame.camera, frame.time))
        for value, rows in ((math.nan, slice(20, 35)), (math.inf, slice(35, 45)), (50.0, slice(45, 60))):
            depth[rows, 30:90] = value
        dirty.integrate(DepthFrame(depth, frame.T_world_camera, frame.camera, frame.time))
    for name, values in clean.volume.channels.items():
        assert np.array_equal(values, dirty.volume.channels[name]) and np.isfinite(values).all()


@every_method
def test_the_volume_grows_and_keeps_what_it_has(method) -> None:
    camera = PinholeCamera.from_fov(80, 60, math.radians(60))
    mapper = mapped(method, frames=0, rebuild_period=0.0)
    sdf = furnished_room()
    mapper.integrate(render(sdf, look_at((0, 0, 1.2), (2, 0, 0.9)), camera, 0.0))
    before, field = mapper.volume.shape, mapper.field()
    seen, ahead = torch.tensor([[1.0, 0.0, 1.1]]), torch.tensor([[-1.0, 0.0, 1.1]])
    old = field.distance(seen), field.confidence(ahead)
    mapper.integrate(render(sdf, look_at((0, 0, 1.2), (-2, 0.2, 0.9)), camera, 0.1))
    assert np.prod(mapper.volume.shape) > np.prod(before)
    assert mapper.field().confidence(ahead).item() == 1 and mapper.field().confidence(seen).item() == 1
    # The second view shows nearer things, so distances may only become smaller.
    assert mapper.field().distance(seen) <= old[0] + 1e-5
    # The old snapshot knows nothing of it.
    assert old[1].item() == field.confidence(ahead).item() == 0 and torch.equal(field.distance(seen), old[0])


def test_a_moved_volume_answers_as_one_made_at_once() -> None:
    frames = furnished_orbit(12, 160)[:4]
    grown, at_once = TsdfVolume(TsdfConfig()), TsdfVolume(TsdfConfig())
    at_once.include(np.array([-4.0, -4.0, -2.0]), np.array([4.0, 4.0, 4.0]))
    for frame in frames:
        grown.fuse(frame)
        at_once.fuse(frame)
    offset = grown.corner - at_once.corner
    inner = tuple(slice(o, o + n) for o, n in zip(offset, grown.shape, strict=True))
    # A voxel that projects onto the edge of two pixels may fall into either.
    same = np.isclose(grown.distance, at_once.distance[inner], atol=1e-4)
    assert same.mean() > 0.999
    assert at_once.weight.sum() == pytest.approx(grown.weight.sum(), rel=1e-3)


@every_method
def test_a_lost_pose_is_refused_and_changes_nothing(method) -> None:
    mapper = mapped(method, frames=2)
    lost = furnished_orbit(12, 160)[2]
    T = lost.T_world_camera.clone()
    T[:3, 3] += 1e5
    before = {name: values.copy() for name, values in mapper.volume.channels.items()}
    with pytest.raises(FrameError, match="max_voxels"):
        mapper.integrate(DepthFrame(lost.depth, T, lost.camera))
    far = DepthFrame(torch.full_like(lost.depth, 20.0), lost.T_world_camera, lost.camera)
    with pytest.raises(FrameError, match="max_depth"):
        mapper.integrate(far)
    assert mapper.frames_seen == 2
    assert all(np.array_equal(values, before[name]) for name, values in mapper.volume.channels.items())


@every_method
def test_what_has_moved_away_is_forgotten(method) -> None:
    camera = PinholeCamera.from_fov(80, 60, math.radians(60))
    near = DepthFrame(torch.full((60, 80), 1.0), np.eye(4), camera, 0.0)
    mapper, here = mapped(method, frames=0), torch.tensor([[0.0, 0.0, 1.0]])
    mapper.integrate(near)
    assert mapper.field().distance(here).abs().item() < 0.1
    generator = np.random.default_rng(0)
    for _ in range(40):
        # The camera moves a little: methods that drop rays leave the same gaps in every image from one place.
        T = np.eye(4)
        T[:2, 3] = generator.uniform(-0.1, 0.1, 2)
        mapper.integrate(DepthFrame(torch.full((60, 80), 2.0), T, camera, 0.0))
    mapper.refresh()
    assert mapper.field().distance(here).item() == pytest.approx(1.0, abs=0.1)


def test_the_weight_of_the_past_is_limited() -> None:
    """What was seen often before it moved must not count for ever."""
    camera = PinholeCamera.from_fov(80, 60, math.radians(60))
    volume = TsdfVolume(TsdfConfig(max_weight=5.0))
    for _ in range(20):
        volume.fuse(DepthFrame(torch.full((60, 80), 1.0), np.eye(4), camera))
    assert volume.weight.max() == 5.0


@every_method
def test_distances_are_rebuilt_once_a_period(method) -> None:
    mapper = MAPPERS[method]()
    with pytest.raises(NotReadyError):
        mapper.field()
    with pytest.raises(NotReadyError):
        mapper.save("never.safetensors")
    for i, frame in enumerate(furnished_orbit(12, 160)):
        mapper.integrate(DepthFrame(frame.depth, frame.T_world_camera, frame.camera, 0.25 * i))
        assert mapper.steps == 1 + i // 4
    assert mapper.run_for(10.0) == 0 and mapper.step() == 0.0 and mapper.steps == 3
    mapper.refresh()
    mapper.refresh()
    assert mapper.steps == 4
    # Without a clock every frame counts.
    timeless = SimpleNamespace(depth=frame.depth, T_world_camera=frame.T_world_camera, camera=frame.camera)
    mapper.integrate(timeless)
    mapper.integrate(timeless)
    assert mapper.steps == 6


@every_method
def test_a_saved_map_answers_as_before_and_goes_on(rooms, method, tmp_path) -> None:
    mapper = mapped(method, frames=5)
    mapper.save(tmp_path / "map.safetensors")
    loaded = load_map(tmp_path / "map.safetensors")
    assert type(loaded) is type(mapper) and loaded.config == mapper.config
    points = visible_points(1200)
    for one in (mapper, loaded):
        one.integrate(furnished_orbit(12, 160)[6])
        one.refresh()
    for a, b in zip(
        mapper.field().distance_and_gradient(points),
        loaded.field().distance_and_gradient(points),
        strict=True,
    ):
        assert torch.equal(a, b)
    assert torch.equal(mapper.field().confidence(points), loaded.field().confidence(points))
    assert torch.equal(mapper.bounds, loaded.bounds) and mapper.frames_seen == loaded.frames_seen == 6
    assert [p.name for p in tmp_path.iterdir()] == ["map.safetensors"]


def test_files_of_another_kind_are_named(rooms, tmp_path) -> None:
    path = tmp_path / "map.safetensors"
    mapped("kinectfusion", frames=1).save(path)
    for cls in (IsdfMapper, ExactMapper):
        with pytest.raises(CheckpointError, match=r"isdf-kinectfusion-map.*load_map"):
            cls.load(path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(CheckpointError, match="not a readable map"):
        load_map(path)
    with pytest.raises(CheckpointError, match="no such file"):
        load_map(tmp_path / "none")


@pytest.mark.parametrize(
    "make",
    [
        *(
            partial(kind, **{name: value})
            for kind in (ExactConfig, VoxbloxConfig, FiestaConfig, KinectFusionConfig)
            for name in ("voxel", "max_depth")
            for value in (0.0, -1.0, math.nan, math.inf)
        ),
        partial(ExactConfig, truncation=0.0),
        partial(ExactConfig, truncation_voxels=1.0),
        partial(ExactConfig, truncation_noise=-0.1),
        partial(ExactConfig, max_weight=0.0),
        partial(ExactConfig, patch=2.0),
        partial(ExactConfig, rebuild_period=-1.0),
        partial(KinectFusionConfig, rebuild_period=math.nan),
        partial(KinectFusionConfig, hit=0.0),
        partial(KinectFusionConfig, front=-1.0),
    ],
)
def test_bad_configs_are_refused(make) -> None:
    with pytest.raises(ConfigError, match="got"):
        make()


@pytest.fixture
def sequence_dir(tmp_path) -> Path:
    frames = furnished_orbit(12, 160)
    writer = SequenceWriter(tmp_path / "room", frames[0].camera, fps=10.0)
    for frame in frames:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    return tmp_path / "room"


def run_cli(monkeypatch, *words: object) -> None:
    monkeypatch.setattr("sys.argv", ["isdf", *map(str, words)])
    main()


@every_method
def test_the_command_maps_and_answers(method, sequence_dir, tmp_path, monkeypatch, capsys) -> None:
    out = tmp_path / "run"
    run_cli(monkeypatch, "map", sequence_dir, "--out", out, "--method", method, "--steps-per-frame", 1)
    report = json.loads((out / "report.json").read_text())
    assert report["method"] == method and report["frames_used"] == 12 and report["keyframes"] == 0
    assert len(trimesh.load(out / "mesh.ply").faces) == report["mesh_faces"] > 1000
    assert Image.open(out / "slices.png").size[0] > 500
    points = np.concatenate([visible_points(96).numpy(), np.full((1, 3), 7.0)])
    np.save(tmp_path / "points.npy", points)
    run_cli(monkeypatch, "query", out, "--points", tmp_path / "points.npy", "--out", tmp_path / "answers.npz")
    answers = np.load(tmp_path / "answers.npz")
    expected = load_map(out / "map.safetensors").field().distance(torch.from_numpy(points))
    np.testing.assert_allclose(answers["distance"], expected.numpy(), atol=1e-5)
    assert answers["gradient"].shape == (97, 3)
    assert answers["confidence"][:-1].mean() > COVERAGE[method] - 0.05 and answers["confidence"][-1] == 0


def test_options_of_another_method_are_refused(sequence_dir, tmp_path, monkeypatch, capsys) -> None:
    for words in (
        ("--voxel", 0.1),
        ("--method", "exact", "--preset", "paper"),
        ("--method", "exact", "--voxel", 0),
    ):
        with pytest.raises(SystemExit, match="2"):
            run_cli(monkeypatch, "map", sequence_dir, "--out", tmp_path / "run", *words)
    assert not (tmp_path / "run").exists()


@every_method
def test_the_live_clock_waits_for_frames_and_drops_what_it_is_too_slow_for(method, sequence_dir) -> None:
    config, sequence = MAPPERS[method]().config, RecordedSequence(sequence_dir)
    _, ample = run_at_rate(sequence, config, 20.0, lambda *_: None)
    assert ample.frames_used == 12 and ample.frames_dropped == 0
    # The budget was 24 CPU seconds; waiting is not charged.
    assert ample.cpu_seconds < 6 and ample.sequence_seconds == pytest.approx(1.2)
    mapper, scarce = run_at_rate(sequence, config, 0.02, lambda *_: None)
    assert 0 < scarce.frames_used < 12 and scarce.frames_used + scarce.frames_dropped == 12
    assert mapper.field() is not None and scarce.steps >= 1


@every_method
def test_the_mesh_has_no_faces_where_nothing_was_seen(rooms, method) -> None:
    field = rooms[method].field()
    mesh = zero_level_mesh(field, 0.05)
    centres = torch.tensor(mesh.triangles_center.astype(np.float32))
    assert len(centres) > 5000 and field.confidence(centres).mean() > 0.98
    assert (field.distance(centres).abs() < 0.05).float().mean() > 0.99
    nothing = field.bounds[1] + torch.tensor([[1.0], [2.0]])
    assert len(zero_level_mesh(field, 0.05, nothing).faces) == 0


def test_slices_are_grey_where_nothing_was_seen(rooms) -> None:
    axes = Figure().subplots()
    image = draw_slice(axes, rooms["exact"].field(), 1.0, np.array([0.0, 0.0, 1.0]))
    shown = np.ma.getmaskarray(image.get_array())
    assert 0.05 < shown.mean() < 0.95
