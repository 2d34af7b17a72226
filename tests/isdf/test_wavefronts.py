"""Voxblox and FIESTA: their wavefronts find what a computation from scratch finds, however the map came about."""

import json
import math

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import save_file
from scipy.ndimage import distance_transform_edt

from isdf import CheckpointError, ConfigError, DepthFrame, PinholeCamera
from isdf.methods import load_map
from isdf.voxel import FiestaConfig, FiestaMapper, VoxbloxConfig, VoxbloxMapper
from isdf.voxel.bundled_tsdf import CHANNELS as TSDF_CHANNELS
from isdf.voxel.nearest_obstacle import FAR, Changes, NearestObstacle
from isdf.voxel.quasi_euclidean import CHANNELS as ESDF_CHANNELS
from isdf.voxel.quasi_euclidean import update_distances
from isdf.voxel.volume import GrowingVolume
from isdf.voxel.wavefront import END, OFFSETS, new_queue, pop, push
from tests.isdf.rooms import ball, furnished_orbit, look_at, render

MAPPERS = {"voxblox": VoxbloxMapper, "fiesta": FiestaMapper}
every_method = pytest.mark.parametrize("method", MAPPERS)
CAMERA = PinholeCamera.from_fov(160, 120, math.radians(60))


def test_the_queue_gives_each_voxel_once_and_lowest_first() -> None:
    generator = np.random.default_rng(2)
    queue, keys = new_queue(100, 8), generator.integers(0, 12, 100)
    for voxel in range(100):
        push(queue, voxel, keys[voxel])
        push(queue, voxel, 0)
    out = [pop(queue) for _ in range(100)]
    assert sorted(out) == list(range(100)) and pop(queue) == END
    assert (np.diff(np.minimum(keys[out], 7)) >= 0).all()
    assert np.array_equal(OFFSETS, -OFFSETS[::-1])


def box_volume(points: np.ndarray, size: int = 32, band: float = 0.25) -> GrowingVolume:
    """A fully mapped box of 10 cm voxels around single surface voxels; all else is in front of them."""
    volume = GrowingVolume(0.1, TSDF_CHANNELS | ESDF_CHANNELS, 1 << 20)
    volume.include(np.zeros(3), np.full(3, 0.1 * (size - 2)))
    volume.channels["distance"][:] = 2 * band
    volume.channels["distance"][tuple(points.T)] = 0.0
    volume.channels["changed"][:] = 1
    return volume


def exact_distance(volume: GrowingVolume, points: np.ndarray) -> np.ndarray:
    empty = np.ones(volume.shape, dtype=bool)
    empty[tuple(points.T)] = False
    return distance_transform_edt(empty) * volume.voxel


def test_quasi_euclidean_distances_are_never_too_small_and_at_most_an_eighth_too_large() -> None:
    """In a mapped box they are the lengths of paths along the 26 directions: at worst sqrt(1 + (sqrt 2 - 1)^2 +
    (sqrt 3 - sqrt 2)^2) = 1.128 times the distance, and 1.082 times within a plane of voxels."""
    points = np.random.default_rng(0).integers(0, 32, (5, 3))
    volume = box_volume(points)
    update_distances(volume, 0.05, 10.0)
    ratio = volume.channels["esdf"] / np.maximum(exact_distance(volume, points), 1e-9)
    away = exact_distance(volume, points) > 0
    assert ratio[away].min() > 1 - 1e-5 and 1.12 < ratio[away].max() < 1.1282
    assert (volume.channels["esdf"][~away] == 0).all()
    flat = box_volume(points[:1])
    update_distances(flat, 0.05, 10.0)
    plane = points[0, 0]
    ratio = flat.channels["esdf"][plane] / np.maximum(exact_distance(flat, points[:1])[plane], 1e-9)
    assert 1.08 < ratio.max() < 1.0825


def test_distances_end_where_no_wave_goes_on() -> None:
    points = np.array([[0, 0, 0]])
    volume = box_volume(points)
    update_distances(volume, 0.05, 1.0)
    far = exact_distance(volume, points) > 1.0
    assert (volume.channels["esdf"][far] == 1.0).all() and volume.channels["esdf"].max() == 1.0


def test_raised_and_lowered_distances_are_as_from_scratch() -> None:
    generator = np.random.default_rng(1)
    first, second = (generator.integers(0, 32, (12, 3)) for _ in range(2))
    changing, scratch = box_volume(first), box_volume(second)
    update_distances(changing, 0.05, 10.0)
    changing.channels["distance"][:] = scratch.channels["distance"]
    changing.channels["changed"][:] = 1
    for volume in (changing, scratch):
        update_distances(volume, 0.05, 10.0)
    # A gain below the tolerance is not passed on, at any step of the way.
    np.testing.assert_allclose(changing.channels["esdf"], scratch.channels["esdf"], atol=2e-3)


def test_nearest_obstacles_are_as_from_scratch_however_they_came_about() -> None:
    """Insertions and deletions over several updates against an exact distance transform, in voxels."""
    generator, shape = np.random.default_rng(3), (24, 20, 28)
    nearest = NearestObstacle(np.zeros(shape, dtype=np.int32))
    mapped, state = np.ones(shape, dtype=bool), np.zeros(shape, dtype=bool)
    fresh = np.arange(state.size)
    for _ in range(6):
        after = generator.random(shape) < 0.004
        nearest.update(
            Changes(np.flatnonzero(after & ~state), np.flatnonzero(state & ~after), fresh), after, mapped
        )
        state, fresh = after, fresh[:0]
        exact = distance_transform_edt(~state)
        found = np.sqrt(nearest.square)
        assert (found >= exact - 1e-6).all()
        assert (found - exact).max() < 0.5 and (found > exact + 1e-6).mean() < 0.002
        lists = nearest.lists
        assert state.reshape(-1)[lists.nearest - 1].all()
        members = sum(1 for o in np.flatnonzero(state) for _ in members_of(lists, o))
        assert members == state.size
    nearest.update(Changes(fresh, np.flatnonzero(state), fresh), np.zeros_like(state), mapped)
    assert (nearest.square == FAR).all() and (nearest.lists.nearest == 0).all()


def members_of(lists, obstacle: int):
    voxel = lists.first[obstacle]
    while voxel != END:
        assert lists.nearest[voxel] == obstacle + 1
        yield voxel
        voxel = lists.after[voxel]


def test_no_distance_is_carried_through_unmapped_voxels() -> None:
    mapped = np.ones((9, 3, 3), dtype=bool)
    mapped[4] = False
    obstacle = np.zeros_like(mapped)
    obstacle[0, 1, 1] = True
    nearest = NearestObstacle(np.zeros(mapped.shape, dtype=np.int32))
    nearest.update(Changes(np.flatnonzero(obstacle), np.arange(0), np.flatnonzero(mapped)), obstacle, mapped)
    assert nearest.square[3, 1, 1] == 9 and (nearest.square[4:] == FAR).all()
    # Once the gap is mapped the far side learns of the obstacle.
    gap = np.flatnonzero(~mapped)
    nearest.update(Changes(np.arange(0), np.arange(0), gap), obstacle, np.ones_like(mapped))
    assert nearest.square[8, 1, 1] == 64


def views(sdf, count: int = 24) -> list[DepthFrame]:
    """Views of what stands at the origin from all around."""
    angles = [2.4 * i for i in range(count)]
    eyes = [(1.6 * math.cos(a), 1.6 * math.sin(a), 0.9 * math.sin(0.7 * a)) for a in angles]
    frames = [render(sdf, look_at(eye, (0.0, 0.0, 0.0)), CAMERA, 0.1 * i) for i, eye in enumerate(eyes)]
    return [DepthFrame(f.depth.where(f.depth < 20, 0), f.T_world_camera, CAMERA, f.time) for f in frames]


@every_method
def test_a_ball_has_its_distances_and_signs(method) -> None:
    mapper = MAPPERS[method]()
    sdf = ball((0.0, 0.0, 0.0), 0.5)
    for frame in views(sdf):
        mapper.integrate(frame)
    mapper.refresh()
    field, generator = mapper.field(), torch.Generator().manual_seed(0)
    ray = torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator), dim=1)
    # Inside only a shell is mapped, and views at flat angles make its projected distances too large.
    for radius, most in ((0.48, 0.06), (0.55, 0.03), (0.65, 0.03)):
        points = radius * ray
        points = points[field.confidence(points) > 0]
        assert len(points) > 2000
        distance, gradient = field.distance_and_gradient(points)
        assert (distance - sdf(points)).abs().mean() < most
        assert ((distance > 0) == (radius > 0.5)).float().mean() > 0.9
        if radius > 0.5:
            assert torch.cosine_similarity(gradient, points, dim=1).mean() > 0.8


@every_method
def test_an_obstacle_that_vanishes_leaves_the_distances_of_what_is_behind(method) -> None:
    """The ball has gone; its place is again as far from the wall as if it had never been there."""
    changed, clean = MAPPERS[method](), MAPPERS[method]()
    wall, generator = np.full((120, 160), 2.5, dtype=np.float32), np.random.default_rng(0)
    with_ball = wall.copy()
    with_ball[45:75, 60:100] = 1.2

    def seen(depth: np.ndarray, time: float) -> DepthFrame:
        T = np.eye(4)
        T[:2, 3] = generator.uniform(-0.1, 0.1, 2)
        return DepthFrame(torch.from_numpy(depth), T, CAMERA, time)

    changed.integrate(seen(with_ball, 0.0))
    there = torch.tensor([[0.0, 0.0, 1.2], [0.05, 0.02, 1.1], [0.0, 0.1, 1.4]])
    assert bool((changed.field().distance(there)[:1].abs() < 0.1).all())
    for i in range(40):
        frame = seen(wall, 0.1 * i)
        changed.integrate(frame)
        clean.integrate(frame)
    changed.refresh()
    clean.refresh()
    torch.testing.assert_close(
        changed.field().distance(there), clean.field().distance(there), atol=0.06, rtol=0
    )
    assert bool((clean.field().distance(there) > 0.9).all())


@every_method
def test_growing_does_not_change_the_answers(method) -> None:
    """Against a volume that was large enough from the start; its lists and parents are in other places."""
    grown, at_once = MAPPERS[method](), MAPPERS[method]()
    at_once.volume.include(np.array([-4.0, -4.0, -2.0]), np.array([4.0, 4.0, 4.0]))
    if method == "fiesta":
        at_once._make_lists()
    frames = furnished_orbit(12, 160)[:6]
    for frame in frames:
        for mapper in (grown, at_once):
            mapper.integrate(frame)
            mapper.refresh()
    points = torch.cat([f.thinned(5, 12.0) for f in frames])
    a, b = grown.field().distance(points), at_once.field().distance(points)
    # Rays are dropped by a table that depends on the size, and rounded elsewhere.
    assert (a - b).abs().mean() < 2e-3
    assert grown.volume.shape != at_once.volume.shape


@every_method
def test_one_image_maps_most_of_its_surfaces_and_leaves_gaps_before_them(method) -> None:
    """What the rays that are dropped would have added is said to be unmapped."""
    mapper, frame = MAPPERS[method](), furnished_orbit(12, 160)[0]
    mapper.integrate(frame)
    field, surface = mapper.field(), frame.thinned(3, 12.0)
    assert field.confidence(surface).mean() > 0.85
    assert field.distance(surface).abs().mean() < 0.07
    eye = frame.T_world_camera[:3, 3].float()
    assert 0.1 < field.confidence(eye + 0.6 * (surface - eye)).mean() < 0.98


def rewritten(path, tensors=None, header=None) -> None:
    """The map file with some tensors and entries of the header replaced."""
    with safe_open(str(path), framework="np") as file:
        old = json.loads(file.metadata()["isdf"])
        kept = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    metadata = {"isdf": json.dumps(old | (header or {}))}
    save_file(kept | (tensors or {}), str(path), metadata=metadata)


@every_method
@pytest.mark.parametrize("fault", ["shape", "axes", "type", "index", "config", "version", "corner"])
def test_files_that_contradict_themselves_are_refused(method, fault, tmp_path) -> None:
    """A wrong index must not become a crash of compiled code."""
    mapper, path = MAPPERS[method](), tmp_path / "map.safetensors"
    mapper.integrate(furnished_orbit(12, 160)[0])
    mapper.save(path)
    index = {"voxblox": "parent", "fiesta": "nearest_free"}[method]
    good = mapper.volume.channels[index].copy()
    bad = good.copy()
    bad[0, 0, 0] = 27 if method == "voxblox" else good.size + 1
    change = {
        "shape": {"tensors": {index: good[:-1].copy()}},
        "axes": {"tensors": {name: c.reshape(-1) for name, c in mapper.volume.channels.items()}},
        "type": {"tensors": {index: good.astype(np.int64)}},
        "index": {"tensors": {index: bad}},
        "config": {"header": {"config": {"voxel": -1.0}}},
        "version": {"header": {"version": 99}},
        "corner": {"header": {"corner": [0, 1]}},
    }
    rewritten(path, **change[fault])
    with pytest.raises(CheckpointError, match="map"):
        load_map(path)


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        (VoxbloxConfig, {"truncation_voxels": 1.0}),
        (VoxbloxConfig, {"band_voxels": 5.0}),
        (VoxbloxConfig, {"max_distance": 0.05}),
        (VoxbloxConfig, {"max_weight": math.nan}),
        (VoxbloxConfig, {"rebuild_period": -1.0}),
        (FiestaConfig, {"hit": 0.4}),
        (FiestaConfig, {"miss": 0.1}),
        (FiestaConfig, {"greatest": 1.0}),
        (FiestaConfig, {"occupied": 0.99}),
        (FiestaConfig, {"rebuild_period": math.nan}),
    ],
)
def test_bad_configs_are_refused(kind, changes) -> None:
    with pytest.raises(ConfigError, match="got"):
        kind(**changes)
