"""The mapper as a whole: it learns a room, keeps the right frames, and survives being saved."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from isdf import (
    CheckpointError,
    ConfigError,
    DivergedError,
    FrameError,
    IsdfConfig,
    IsdfMapper,
    KeyframeConfig,
    LossConfig,
    NetworkConfig,
    NotReadyError,
    SamplingConfig,
    mapfile,
)
from isdf.keyframes import KeyframeSet, explained_share, render_depth
from isdf.meshing import zero_level_mesh
from tests.isdf.rooms import furnished_orbit, furnished_room

SMALL = IsdfConfig(
    network=NetworkConfig(width=32, input_scale=0.12),
    sampling=SamplingConfig(rays_per_frame=10, stratified=5, near_surface=3, extra_surface=40),
    first_frame_steps=5,
    steps_per_frame=3,
    keyframe_steps=2,
)


def mapped(config: IsdfConfig = SMALL, frames: int = 6) -> IsdfMapper:
    mapper = IsdfMapper(config)
    for frame in furnished_orbit(12)[:frames]:
        mapper.integrate(frame)
    return mapper


def visible_points(count: int = 4000) -> torch.Tensor:
    generator = torch.Generator().manual_seed(9)
    points = []
    for frame in furnished_orbit(12):
        surface = frame.thinned(1, 12.0)
        chosen = surface[torch.randint(len(surface), (count // 12,), generator=generator)]
        eye = frame.T_world_camera[:3, 3].float()
        points.append(eye + torch.rand(len(chosen), 1, generator=generator) * (chosen - eye))
    return torch.cat(points)


@pytest.fixture(scope="module")
def room_map() -> IsdfMapper:
    mapper = IsdfMapper(replace(IsdfConfig(), seed=3))
    for _ in range(2):
        for frame in furnished_orbit(12):
            mapper.integrate(replace_time(frame, mapper.frames_seen / 10))
    while mapper.steps < 400:
        mapper.step()
    return mapper


def replace_time(frame, time: float):
    return SimpleNamespace(
        depth=frame.depth, T_world_camera=frame.T_world_camera, camera=frame.camera, time=time
    )


def test_it_learns_a_furnished_room(room_map: IsdfMapper) -> None:
    points = visible_points()
    distance, gradient = room_map.field().distance_and_gradient(points)
    truth = furnished_room()(points)
    error = (distance - truth).abs()
    assert error.mean() < 0.08, f"mean error {error.mean():.3f} m"
    assert error[truth < 0.2].mean() < 0.05
    # The trivial answer, a constant, must be far worse than what was learned.
    assert error.mean() < 0.25 * (truth - truth.mean()).abs().mean()
    assert (gradient.norm(dim=-1) - 1).abs().mean() < 0.3


def test_the_mesh_is_the_room(room_map: IsdfMapper) -> None:
    mesh = zero_level_mesh(room_map.field(), 0.08)
    assert len(mesh.faces) > 2000
    seen = torch.cat([frame.thinned(4, 12.0) for frame in furnished_orbit(12)])
    gap = torch.cdist(seen[::5], torch.tensor(mesh.vertices, dtype=torch.float32)).amin(dim=1)
    assert gap.median() < 0.08
    with pytest.raises(ConfigError, match="choose a spacing"):
        zero_level_mesh(room_map.field(), 0.0005)


def test_the_cost_field_is_the_cost_of_a_snapshot(room_map: IsdfMapper) -> None:
    points = visible_points(240)
    cost, gradient = room_map.cost_field(0.5).cost_and_gradient(points)
    distance = room_map.field().distance(points)
    expected = torch.where(distance < 0, 0.25 - distance, (distance - 0.5).clamp(max=0) ** 2)
    torch.testing.assert_close(cost, expected)
    assert bool((gradient[distance > 0.5] == 0).all())


def test_a_frame_with_news_becomes_a_keyframe_and_the_same_view_does_not() -> None:
    frames = furnished_orbit(12)
    mapper = IsdfMapper(replace(SMALL, first_frame_steps=150, steps_per_frame=5))
    mapper.integrate(frames[0])
    mapper.integrate(frames[0])
    assert len(mapper.keyframes) == 1
    mapper.integrate(frames[6])  # the opposite view
    assert len(mapper.keyframes) == 2


def test_a_keyframe_is_forced_after_the_time_limit() -> None:
    frame = furnished_orbit(12)[0]
    for gap, keyframes in ((4.9, 1), (5.1, 2)):
        mapper = IsdfMapper(replace(SMALL, first_frame_steps=150))
        mapper.integrate(replace_time(frame, 0.0))
        mapper.integrate(replace_time(frame, gap))
        assert len(mapper.keyframes) == keyframes


def test_information_gain_compares_with_the_frozen_copy_not_the_live_network() -> None:
    mapper = IsdfMapper(replace(SMALL, first_frame_steps=150))
    frame = furnished_orbit(12)[0]
    mapper.integrate(frame)
    mapper.integrate(replace_time(frame, 0.1))
    share = explained_share(mapper._frozen, frame, KeyframeConfig(), SamplingConfig(), torch.Generator())
    assert share > 0.65
    with torch.no_grad():
        mapper.network.layers[-1].bias += 10.0  # the live network now explains nothing
    mapper.integrate(replace_time(frame, 0.2))
    assert len(mapper.keyframes) == 1


def test_the_frozen_copy_knows_all_that_the_keyframe_taught() -> None:
    frames = furnished_orbit(12)
    mapper = IsdfMapper(replace(SMALL, first_frame_steps=20, steps_per_frame=2, keyframe_steps=15))

    def frozen_is_live() -> bool:
        pairs = zip(mapper._frozen.parameters(), mapper.network.parameters(), strict=True)
        return all(torch.equal(a, b) for a, b in pairs)

    mapper.integrate(frames[0])
    mapper.integrate(frames[6])  # the opposite view: a keyframe, whose further steps come after it is judged
    assert len(mapper.keyframes) == 2 and mapper.steps == 37 and not frozen_is_live()
    mapper.config = replace(mapper.config, steps_per_frame=0)
    mapper.integrate(frames[6])
    assert frozen_is_live()


def test_noise_doubles_while_a_keyframe_gets_its_further_steps() -> None:
    frames = furnished_orbit(12)
    mapper = IsdfMapper(replace(SMALL, losses=LossConfig(noise=0.04), first_frame_steps=1))
    zero = torch.zeros(40_000)
    mapper.integrate(frames[0])
    first = float(mapper._training_noise(zero).std())
    mapper.integrate(frames[6])
    assert len(mapper.keyframes) == 2
    assert first == pytest.approx(0.04 * 0.14, rel=0.03)
    assert float(mapper._training_noise(zero).std()) == pytest.approx(2 * first, rel=0.05)


def test_rendered_depth_is_where_the_field_crosses_zero() -> None:
    plane = lambda p: 2.0 - p[:, 2]  # noqa: E731
    direction = torch.tensor([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.0, 1.0, 0.1]])
    z = torch.linspace(0.05, 1.2, 20) * torch.tensor([[2.0], [2.2], [1.0]])
    rendered = render_depth(plane, z, direction, torch.zeros(3))
    torch.testing.assert_close(rendered, torch.tensor([2.0, 2.0, torch.inf]))


def test_replay_prefers_keyframes_with_high_loss_and_never_repeats() -> None:
    keyframes = KeyframeSet(list(furnished_orbit(12)[:6]), [1e-3, 1e-3, 5.0, 1e-3, 5.0, 100.0])
    generator = torch.Generator().manual_seed(0)
    drawn = [keyframes.draw(3, 5, generator) for _ in range(200)]
    assert all(len(set(d)) == 3 and 5 not in d for d in drawn)  # the last one is in every window anyway
    assert sum({2, 4} <= set(d) for d in drawn) > 190
    assert KeyframeSet(keyframes.frames[:1], [1.0]).draw(3, 0, generator) == []


@pytest.mark.parametrize("kept", [1, 2, 4, 8])
def test_the_window_is_newest_last_keyframe_and_replayed(kept) -> None:
    frames = list(furnished_orbit(12))
    mapper = IsdfMapper(replace(SMALL, first_frame_steps=0, steps_per_frame=0))
    mapper.integrate(frames[0])
    mapper.keyframes = KeyframeSet(frames[:kept], [1.0] * kept)
    for newest in (frames[11], frames[kept - 1]):  # passing by, and itself the last keyframe
        mapper._newest = newest
        window, indices = mapper._select()
        before = kept - (newest is frames[kept - 1])
        assert window[0] is newest and len(window) == 1 + min(4, before)
        if before:
            assert window[1] is frames[before - 1]
        assert len({id(f) for f in window}) == len(window)
        assert [id(frames[i]) for i in indices] == [id(f) for f in window[len(window) - len(indices) :]]
        assert len(indices) == len(window) - (newest is frames[11])


@pytest.mark.parametrize("bound", ["ray", "normal", "batch"])
def test_every_bound_trains(bound) -> None:
    mapper = IsdfMapper(replace(SMALL, bound=bound, first_frame_steps=0))
    mapper.integrate(furnished_orbit(12)[0])
    losses = [mapper.step() for _ in range(160)]
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:10])


def test_the_papers_and_the_released_sizes_make_a_step() -> None:
    for config in (IsdfConfig.paper(), IsdfConfig.released()):
        small = replace(config, sampling=replace(config.sampling, rays_per_frame=5), first_frame_steps=2)
        mapper = IsdfMapper(small)
        mapper.integrate(furnished_orbit(12)[0])
        assert mapper.steps == 2 and mapper.network.config.width == 256


def test_run_for_keeps_to_its_budget_and_makes_at_least_one_step() -> None:
    mapper = mapped()
    assert mapper.run_for(0.0) == 1
    assert mapper.run_for(0.3) > 3


def test_an_unusable_frame_changes_nothing() -> None:
    mapper = mapped()
    before = [p.clone() for p in mapper.network.parameters()]
    frame = furnished_orbit(12)[0]
    bad = SimpleNamespace(
        depth=torch.full_like(frame.depth, torch.nan), T_world_camera=np.eye(4), camera=frame.camera
    )
    with pytest.raises(FrameError, match="no valid pixel"):
        mapper.integrate(bad)
    with pytest.raises(FrameError, match="max_depth"):
        mapper.integrate(
            SimpleNamespace(depth=frame.depth * 0 + 30, T_world_camera=np.eye(4), camera=frame.camera)
        )
    assert mapper.frames_seen == 6
    assert all(torch.equal(a, b) for a, b in zip(before, mapper.network.parameters(), strict=True))


def test_an_empty_map_says_what_to_do() -> None:
    for ask in (
        IsdfMapper().field,
        IsdfMapper().step,
        lambda: IsdfMapper().bounds,
        lambda: IsdfMapper().save("/tmp/never"),
    ):
        with pytest.raises(NotReadyError, match="integrate"):
            ask()


def test_the_same_seed_gives_the_same_map_and_another_seed_another() -> None:
    points = visible_points(120)
    first, again, other = (mapped(replace(SMALL, seed=s)).field().distance(points) for s in (1, 1, 2))
    assert torch.equal(first, again) and not torch.allclose(first, other)


def test_saving_and_loading_continues_identically(tmp_path) -> None:
    mapper = mapped(replace(SMALL, losses=LossConfig(noise=0.04)))
    mapper.save(tmp_path / "map.safetensors")
    loaded = IsdfMapper.load(tmp_path / "map.safetensors")
    assert loaded.config == mapper.config and loaded.steps == mapper.steps
    for frame in furnished_orbit(12)[6:]:
        mapper.integrate(frame)
        loaded.integrate(frame)
    assert mapper.step() == loaded.step()
    points = visible_points(120)
    assert torch.equal(mapper.field().distance(points), loaded.field().distance(points))
    assert (
        len(mapper.keyframes) == len(loaded.keyframes) and mapper.keyframes.losses == loaded.keyframes.losses
    )
    assert torch.equal(mapper.bounds, loaded.bounds)


def test_a_failed_save_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch) -> None:
    mapper, path = mapped(), tmp_path / "map.safetensors"
    mapper.save(path)
    before = path.read_bytes()
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    mapper.step()
    with pytest.raises(OSError, match="disk full"):
        mapper.save(path)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["map.safetensors"]


def test_foreign_damaged_and_newer_files_are_refused(tmp_path) -> None:
    path = tmp_path / "map.safetensors"
    with pytest.raises(CheckpointError, match="no such file"):
        IsdfMapper.load(path)
    mapped().save(path)
    data = path.read_bytes()
    (tmp_path / "cut").write_bytes(data[: len(data) // 2])
    with pytest.raises(CheckpointError, match="not a readable map"):
        IsdfMapper.load(tmp_path / "cut")
    save_file({"x": torch.zeros(1)}, tmp_path / "foreign")
    with pytest.raises(CheckpointError, match="not a map written by this package"):
        IsdfMapper.load(tmp_path / "foreign")
    with safe_open(path, "pt") as file:
        header = json.loads(file.metadata()["isdf"])
        tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    save_file(tensors, tmp_path / "newer", {"isdf": json.dumps(header | {"version": 99})})
    with pytest.raises(CheckpointError, match="version 99"):
        IsdfMapper.load(tmp_path / "newer")
    del tensors["network.layers.0.weight"]
    mapfile.write(tmp_path / "partial", tensors, header)
    with pytest.raises(CheckpointError, match="incomplete or inconsistent"):
        IsdfMapper.load(tmp_path / "partial")


@pytest.mark.parametrize("bad", [{"learning_rate": 0.0}, {"weight_decay": -1.0}, {"steps_per_frame": -1}])
def test_impossible_configurations_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError):
        IsdfConfig(**bad)


def test_a_diverged_training_says_so_and_leaves_the_network() -> None:
    mapper = mapped(frames=2)
    with torch.no_grad():
        mapper.network.layers[0].weight.mul_(1e30)
    before = [p.clone() for p in mapper.network.parameters()]
    with pytest.raises(DivergedError, match="lower learning_rate"):
        mapper.step()
    assert all(torch.equal(a, b) for a, b in zip(before, mapper.network.parameters(), strict=True))
