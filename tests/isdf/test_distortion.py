"""The camera's own distortion: learned from walls seen through several parts of the image."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from isdf import Mapper, MapperConfig, PinholeCamera
from isdf.errors import CheckpointError, ConfigError
from isdf.mapping.distortion import DEGREE, Distortion, Key, polynomials
from isdf.mapping.facets import Facets
from tests.isdf.rooms import furnished_room, look_at, render
from tests.isdf.test_mapping import visible_points

INTRINSICS = (60.0, 60.0, 39.5, 29.5)


def bowl(height=60, width=80, size=0.01):
    """Relative depth errors that no low polynomial is equal to."""
    down, across = np.mgrid[:height, :width] / height
    out = np.cos(4.5 * across) + np.sin(3.0 * down + across)
    return size * (out - out.mean()) / out.std()


def distorted(frames, relative):
    return [replace(f, depth=f.depth * torch.from_numpy(1 + relative).float()) for f in frames]


def intrinsics_of(frame):
    camera = frame.camera
    return camera.fx, camera.fy, camera.cx, camera.cy


def taught(frames, sigma=0.01, poses=None):
    out = Distortion(sigma)
    for index, frame in enumerate(frames):
        depth, T = frame.depth.numpy(), frame.T_world_camera.numpy()
        out.correct(depth, intrinsics_of(frame))
        out.learn(depth, intrinsics_of(frame), T if poses is None else poses[index])
    return out


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture(scope="module")
def views():
    """A camera that looks about, up and down, walking to and fro: walls come by in all parts of its image."""
    camera, out = PinholeCamera.from_fov(80, 60, math.radians(60)), []
    for n in range(60):
        turn, tilt = 0.11 * n, 0.5 * math.sin(0.9 * n)
        eye = (0.5 * math.cos(0.3 * n), -0.3 + 0.4 * math.sin(0.23 * n), 1.2 + 0.1 * math.sin(0.7 * n))
        target = (eye[0] + math.cos(turn), eye[1] + math.sin(turn), eye[2] - 0.25 + tilt)
        out.append(render(furnished_room(), look_at(eye, target), camera, n / 10))
    return out


def test_it_is_learned_from_what_is_seen_twice(views):
    truth = bowl()
    learned = taught(distorted(views, truth)).relative(60, 80)
    assert rms(learned - truth) < 0.25 * rms(truth)
    first = taught(distorted(views[:8], truth)).relative(60, 80)
    assert rms(learned - truth) < rms(first - truth) < 0.9 * rms(truth)


def test_a_camera_without_it_stays_as_it_is(views):
    assert rms(taught(views).relative(60, 80)) < 3e-4


def test_what_poses_do_wrong_is_not_laid_to_the_camera(views):
    rng = np.random.default_rng(0)
    poses = []
    for view in views:
        T = view.T_world_camera.numpy().copy()
        T[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.005, 3)).as_matrix() @ T[:3, :3]
        T[:3, 3] += rng.normal(0, 0.01, 3)
        poses.append(T)
    assert rms(taught(views, poses=poses).relative(60, 80)) < 0.0035
    truth = bowl()
    assert rms(taught(distorted(views, truth), poses=poses).relative(60, 80) - truth) < 0.5 * rms(truth)


@pytest.mark.parametrize("shift", [0.06, 0.5])
def test_what_has_moved_between_two_views_counts_little(views, shift):
    """A little, as a chair that was pushed, or a lot, as somebody who walks by."""
    truth, moved, rng = bowl(), [], np.random.default_rng(0)
    for view in distorted(views, truth):
        depth, row, column = view.depth.clone(), rng.integers(0, 30), rng.integers(0, 50)
        part = depth[row : row + 30, column : column + 30]
        part -= shift * (part > 1)
        moved.append(replace(view, depth=depth))
    error = rms(taught(moved).relative(60, 80) - truth)
    assert error < 0.3 * rms(truth)


def test_a_corrected_image_is_what_a_camera_without_it_measures(views):
    truth = bowl()
    frames = distorted(views, truth)
    found = taught(frames)
    depth = found.correct(frames[3].depth.numpy(), intrinsics_of(frames[3]))
    assert depth.dtype == np.float32
    wrong = (frames[3].depth - views[3].depth).abs().mean()
    assert np.abs(depth - views[3].depth.numpy()).mean() < 0.25 * wrong


def test_another_camera_starts_anew(views):
    found = taught(distorted(views, bowl()))
    depth = views[0].depth.numpy()
    other = (found.key.intrinsics[0] + 1, *found.key.intrinsics[1:])
    assert found.correct(depth, other) is depth
    assert not found.information.any() and found.key == Key((60, 80), other)
    np.testing.assert_array_equal(found.relative(60, 80), 0)


def test_none_is_looked_for_where_none_is_expected(views):
    found = taught(distorted(views[:6], bowl()), sigma=0.0)
    np.testing.assert_array_equal(found.relative(60, 80), 0)
    depth = views[0].depth.numpy()
    assert found.correct(depth, intrinsics_of(views[0])) is depth
    for wrong in (-0.01, 0.5, float("nan")):
        with pytest.raises(ConfigError, match="distortion"):
            MapperConfig(distortion=wrong)


def test_a_map_is_freed_of_it(views):
    frames, sdf, errors = distorted(views, bowl(size=0.02)), furnished_room(), {}
    points = visible_points(views, 60)
    for sigma in (0.0, 0.01):
        mapper = Mapper(MapperConfig(distortion=sigma))
        for frame in frames:
            mapper.integrate(frame)
        mapper.refresh()
        error = mapper.field().distance(points) - sdf(points)
        sure = mapper.field().confidence(points) > 0.9
        errors[sigma] = float(error[sure].abs().mean())
    assert errors[0.01] < 0.7 * errors[0.0]


def test_a_map_learns_from_what_was_measured(views):
    """Not from images that it has corrected: they would tell it that all is well."""
    frames, mapper = distorted(views, bowl()), Mapper()
    for frame in frames:
        mapper.integrate(frame)
    assert mapper.frames_skipped == 0
    np.testing.assert_allclose(mapper.distortion.relative(60, 80), taught(frames).relative(60, 80), atol=1e-6)


def test_a_saved_map_knows_its_camera(tmp_path, views):
    frames = distorted(views, bowl())
    mapper = Mapper()
    for frame in frames[:20]:
        mapper.integrate(frame)
    mapper.save(tmp_path / "map")
    again = Mapper.load(tmp_path / "map")
    assert again.distortion.key == mapper.distortion.key
    before = mapper.distortion.relative(60, 80)
    assert rms(before) > 0.003
    np.testing.assert_allclose(again.distortion.relative(60, 80), before)
    depth = frames[0].depth.numpy()
    np.testing.assert_array_equal(
        again.distortion.correct(depth, intrinsics_of(frames[0])),
        mapper.distortion.correct(depth, intrinsics_of(frames[0])),
    )
    again.integrate(frames[20])
    assert again.distortion.key == mapper.distortion.key and again.distortion.information.any()


def test_a_file_with_half_a_calibration_is_refused(tmp_path, views, monkeypatch):
    mapper = Mapper()
    mapper.integrate(views[0])
    mapper.distortion.vector[0] = np.inf
    mapper.save(tmp_path / "map")
    with pytest.raises(CheckpointError, match="distortion"):
        Mapper.load(tmp_path / "map")


def test_polynomials_are_of_mean_square_one_and_independent():
    values = polynomials(400)
    np.testing.assert_allclose(values.T @ values / 400, np.eye(DEGREE + 1), atol=2e-3)


def test_facets_are_the_planes_of_an_image_and_leave_out_its_edges():
    v, u = np.mgrid[:60, :80]
    rays = np.stack([(u - 39.5) / 60, (v - 29.5) / 60, np.ones(u.shape)], axis=-1)
    normal = np.array([0.6, 0.0, 0.8])
    depth = 1.6 / (rays @ normal)
    depth[:, 40:] = 3.0
    depth[40:, 60:] = 3.05
    depth[10, 10] = 0.0
    facets = Facets.of(depth.astype(np.float32), INTRINSICS, np.eye(4))
    assert facets.flat[20, 10] and facets.flat[20, 60]
    np.testing.assert_allclose(facets.normals[20, 10], normal, atol=1e-3)
    np.testing.assert_allclose(facets.normals[20, 60], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(1 / facets.inverse[20, 60], 3.0, rtol=1e-6)
    assert not facets.flat[:, 39:41].any() and not facets.flat[9:12, 9:12].any()
    assert not facets.flat[39:41, 61:].any() and facets.flat[38, 61:79].all() and facets.flat[41, 61:79].all()
    assert not facets.flat[0].any() and not facets.flat[:, -1].any()


def test_a_plane_seen_at_a_glance_is_no_facet():
    v, u = np.mgrid[:60, :80]
    rays = np.stack([(u - 39.5) / 60, (v - 29.5) / 60, np.ones(u.shape)], axis=-1)
    floor = np.array([0.0, 0.98, 0.2])
    depth = np.where(rays @ floor > 0.05, 0.8 / np.maximum(rays @ floor, 0.05), 0.0)
    facets = Facets.of(depth.astype(np.float32), INTRINSICS, np.eye(4))
    cosine = rays @ floor / np.linalg.norm(rays, axis=-1)
    assert facets.flat[cosine > 0.32].mean() > 0.8 and not facets.flat[cosine < 0.28].any()


def test_facets_of_a_large_image_are_squares_of_its_pixels():
    v, u = np.mgrid[:240, :320]
    rays = np.stack([(u - 159.5) / 240, (v - 119.5) / 240, np.ones(u.shape)], axis=-1)
    normal = np.array([0.28, 0.0, 0.96])
    facets = Facets.of((2.0 / (rays @ normal)).astype(np.float32), (240.0, 240.0, 159.5, 119.5), np.eye(4))
    assert facets.flat.shape == (60, 80) and facets.flat[1:-1, 1:-1].all()
    np.testing.assert_allclose(facets.normals[30, 40], normal, atol=1e-3)
    # The middle of a square lies on the plane.
    np.testing.assert_allclose((facets.rays[30, 40] / facets.inverse[30, 40]) @ normal, 2.0, atol=1e-3)
