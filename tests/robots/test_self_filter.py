"""The robot is removed from depth images: exactly the pixels whose point lies in an enlarged sphere."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import robots

CAMERA = SimpleNamespace(fx=100.0, fy=110.0, cx=79.5, cy=59.5, width=160, height=120)


def back_projected(depth: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    v, u = np.indices(depth.shape)
    local = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx * depth, (v - CAMERA.cy) / CAMERA.fy * depth, depth], axis=-1
    )
    return local @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def random_pose(rng: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
    pose[:3, 3] = rng.normal(size=3)
    return pose


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_testing_every_pixel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = random_pose(rng)
    depth = rng.uniform(0.3, 3.0, (120, 160)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0.0
    points = back_projected(depth, pose)
    # Spheres about seen points, beside the image, behind and around the camera.
    centres = np.concatenate([points[::20, ::25].reshape(-1, 3), pose[:3, 3] + rng.normal(size=(30, 3))])
    radii = rng.uniform(0.02, 0.3, len(centres))
    inside = np.zeros(depth.shape, dtype=bool)
    for centre, radius in zip(centres, radii, strict=True):
        inside |= np.linalg.norm(points - centre, axis=-1) <= radius + 0.03
    before = depth.copy()
    filtered = robots.remove_robot(depth, CAMERA, pose, centres, radii, margin=0.03)
    np.testing.assert_array_equal(filtered, np.where(inside, 0, depth))
    np.testing.assert_array_equal(depth, before)
    assert filtered.dtype == np.float32


def test_what_is_behind_the_robot_stays() -> None:
    depth = np.full((120, 160), 2.0, dtype=np.float32)
    depth[40:80, 60:100] = 1.0
    filtered = robots.remove_robot(depth, CAMERA, np.eye(4), np.array([[0.0, 0.0, 1.0]]), np.array([0.5]))
    assert (filtered[40:80, 60:100] == 0).all()
    assert (filtered[depth == 2.0] == 2.0).all()


def test_nan_and_no_spheres() -> None:
    depth = np.full((120, 160), np.nan, dtype=np.float32)
    centre, radius = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([0.4])
    assert np.isnan(robots.remove_robot(depth, CAMERA, np.eye(4), centre, radius)).all()
    depth[:] = 1.0
    assert (robots.remove_robot(depth, CAMERA, np.eye(4), np.zeros((0, 3)), np.zeros(0)) == 1).all()


def test_the_arm_is_removed_from_tiagos_own_view() -> None:
    tiago = robots.load("tiago")
    q = tiago.named["ready"]
    centres, radii = tiago.spheres(q)
    pose = tiago.camera_pose(q, head=(0.0, -0.6))
    local = np.linalg.inv(pose) @ np.c_[centres.double().numpy(), np.ones(len(radii))].T
    hand = [link == "panda_hand" for link in tiago.sphere_links].index(True)
    x, y, z = local[:3, hand]
    u, v = round(CAMERA.cx + CAMERA.fx * x / z), round(CAMERA.cy + CAMERA.fy * y / z)
    assert 0 <= u < 160 and 0 <= v < 120, "the ready posture shows the hand to the camera"
    depth = np.full((120, 160), z, dtype=np.float32)
    assert robots.remove_robot(depth, CAMERA, pose, centres, radii)[v, u] == 0


def test_shapes_are_checked() -> None:
    with pytest.raises(robots.RobotError, match=r"radii \(3,\)"):
        robots.remove_robot(np.zeros((4, 4)), CAMERA, np.eye(4), np.zeros((2, 3)), np.zeros(3))
