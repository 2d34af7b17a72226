"""Frames: what is accepted, what is ignored, what is refused and how."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from isdf import CameraError, DepthFrame, FrameError, PinholeCamera

CAMERA = PinholeCamera(100.0, 100.0, 39.5, 29.5, 80, 60)


def image(value: float = 2.0) -> np.ndarray:
    return np.full((60, 80), value, dtype=np.float32)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0.0, -1.0])
def test_bad_pixels_become_invalid_and_the_rest_stays(bad: float) -> None:
    depth = image()
    depth[5, 7] = bad
    frame = DepthFrame(depth, np.eye(4), CAMERA)
    assert frame.depth[5, 7] == 0 and int((frame.depth == 2).sum()) == 60 * 80 - 1


@pytest.mark.parametrize("bad", [np.nan, 0.0, -2.0])
def test_an_all_invalid_frame_is_refused(bad: float) -> None:
    with pytest.raises(FrameError, match="no valid pixel"):
        DepthFrame(image(bad), np.eye(4), CAMERA)


def test_millimetres_are_refused_with_the_fix() -> None:
    with pytest.raises(FrameError, match="divide it by 1000"):
        DepthFrame(image(2000.0), np.eye(4), CAMERA)
    with pytest.raises(FrameError, match="floating-point metres, got"):
        DepthFrame(image(2000.0).astype(np.uint16), np.eye(4), CAMERA)


@pytest.mark.parametrize("shape", [(80, 60), (60, 80, 1), (60,)])
def test_wrong_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(FrameError, match="depth has shape"):
        DepthFrame(np.full(shape, 2.0, np.float32), np.eye(4), CAMERA)


def bad_poses() -> list[np.ndarray]:
    scaled, mirrored, nan, bottom = np.eye(4), np.eye(4), np.eye(4), np.eye(4)
    scaled[:3, :3] *= 1.01
    mirrored[0, 0] = -1
    nan[0, 3] = np.nan
    bottom[3, 0] = 0.5
    return [scaled, mirrored, nan, bottom, np.eye(3)]


@pytest.mark.parametrize("pose", bad_poses())
def test_poses_that_are_not_rigid_are_refused(pose: np.ndarray) -> None:
    with pytest.raises(FrameError, match="T_world_camera"):
        DepthFrame(image(), pose, CAMERA)


def test_any_object_with_the_attributes_is_a_frame() -> None:
    camera = SimpleNamespace(fx=100, fy=100, cx=39.5, cy=29.5, width=80, height=60)
    frame = DepthFrame.of(SimpleNamespace(depth=image(), T_world_camera=np.eye(4), camera=camera, time=3))
    assert frame.camera == CAMERA and frame.time == 3.0
    with pytest.raises(FrameError, match="no T_world_camera, camera"):
        DepthFrame.of(SimpleNamespace(depth=image()))


def test_frames_do_not_share_memory_with_the_caller() -> None:
    depth = image()
    frame = DepthFrame(depth, np.eye(4), CAMERA)
    depth[:] = 9.0
    assert float(frame.depth.max()) == 2.0


def test_back_projection_is_geometry() -> None:
    camera = PinholeCamera.from_fov(80, 60, math.radians(90))
    centre = camera.rays(torch.tensor([[39, 29], [40, 30]])).mean(dim=0)
    torch.testing.assert_close(centre, torch.tensor([0.0, 0.0, 1.0]))
    edge = camera.rays(torch.tensor([79, 30]))
    assert math.atan2(float(edge[0]), 1.0) == pytest.approx(math.radians(45), abs=0.01)
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    points = DepthFrame(image(), T, CAMERA).thinned(1, 12.0)
    torch.testing.assert_close(points[:, 2], torch.full((4800,), 5.0))


@pytest.mark.parametrize(
    "bad", [{"fx": 0.0}, {"fy": -1.0}, {"cx": math.nan}, {"width": 0}, {"fx": 1e-4}, {"fy": 1e9}, {"cy": 1e6}]
)
def test_impossible_cameras_are_refused(bad: dict) -> None:
    values = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 2, "height": 2} | bad
    with pytest.raises(CameraError):
        PinholeCamera(**values)


def test_a_centre_far_outside_the_image_is_refused() -> None:
    """A wrong centre of a small image would stretch a room over a hundred metres."""
    with pytest.raises(CameraError, match="at most 84 degrees"):
        PinholeCamera(69.3, 69.3, 3537.0, 29.5, 80, 60)
    PinholeCamera(69.3, 69.3, 200.0, 29.5, 80, 60)  # a cut-out of a larger image


def test_places_and_times_that_numbers_cannot_hold_are_refused() -> None:
    far = np.eye(4)
    far[1, 3] = 4.6e6  # a UTM northing
    with pytest.raises(FrameError, match="move the world's origin"):
        DepthFrame(image(), far, CAMERA)
    for time in (math.nan, math.inf):
        with pytest.raises(FrameError, match="time"):
            DepthFrame(image(), np.eye(4), CAMERA, time)


@pytest.mark.parametrize(("fx", "fy"), [(0.4, 21.0), (21.0, 0.4)])
def test_a_camera_of_slivers_for_pixels_is_refused(fx, fy) -> None:
    """One wrong digit in the intrinsics would make a map of a house out of a view of a table."""
    with pytest.raises(CameraError, match="times as long as wide"):
        PinholeCamera(fx, fy, 7.5, 5.0, 16, 12)
    PinholeCamera(21.0, 10.5, 7.5, 5.0, 16, 12)  # binned along one axis
