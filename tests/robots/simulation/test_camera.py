from __future__ import annotations

import os
import pathlib
from dataclasses import replace

import numpy as np
import pytest
import torch

import robots.simulation.camera as camera_module
from robots.errors import RobotError, UnknownLinkError
from robots.simulation import (
    Box,
    DepthCamera,
    PinholeCamera,
    Scene,
    Sphere,
    World,
    load_urdf_scene,
    make_scene,
)
from robots.simulation.poses import planar_pose
from robots.simulation.ray_casting import RayCaster
from tests.robots.simulation.models import CART_JOINTS


def _looking(position, yaw: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    """Camera pose looking along world x turned by yaw, and down by pitch."""
    optical = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=float)
    c, s = np.cos(pitch), np.sin(pitch)
    pose = planar_pose(0, 0, yaw=yaw)
    pose[:3, :3] = pose[:3, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ optical
    pose[:3, 3] = position
    return pose


def test_a_wall_ahead_has_one_depth_whatever_the_pixel():
    with World(Scene("wall", static=(Box("wall", planar_pose(2.1, 0, 0), (0.2, 20.0, 20.0)),))) as world:
        frame = DepthCamera(world, T_link_camera=_looking([0.0, 0.3, 0.2])).render()
    assert frame.depth.shape == (120, 160) and frame.depth.dtype == np.float32
    assert np.allclose(frame.depth, 2.0, atol=1e-5), "z-depth, not length of the ray"


def test_a_frame_tells_which_places_it_shows():
    pillar = Box("pillar", planar_pose(1.0, 0.0, 0.0), (0.2, 0.2, 4.0))
    wall = Box("wall", planar_pose(2.1, 0, 0), (0.2, 20.0, 20.0))
    with World(Scene("yard", static=(pillar, wall))) as world:
        frame = DepthCamera(world, T_link_camera=_looking([0.0, 0.0, 0.5])).render()
    surface, before, beside = [0.9, 0.0, 0.5], [0.6, 0.0, 0.5], [1.2, 0.3, 0.5]
    assert frame.sees(np.array([surface, before, beside])).all()
    behind, in_the_wall, at_the_back, outside = (
        [1.5, 0.0, 0.5],
        [2.2, 0.5, 0.5],
        [-0.9, 0.0, 0.5],
        [0.9, 1.0, 0.5],
    )
    edge = [1.1, 0.1 / 0.9 * 1.1 + 0.005, 0.5]  # less than a pixel beside the pillar's edge
    assert not frame.sees(np.array([behind, in_the_wall, at_the_back, outside, edge])).any()
    assert frame.sees(np.empty((0, 3))).shape == (0,)
    blind = replace(frame, depth=np.zeros_like(frame.depth))
    assert not blind.sees(np.array([surface, before])).any()


def test_a_floor_below_obeys_the_pinhole_equation(yard):
    with World(yard) as world:
        world.remove_body("wall")
        pose = _looking([0.0, 0.0, 1.0], yaw=0.4, pitch=0.6)
        frame = DepthCamera(world, T_link_camera=pose).render()
    rays = frame.camera.rays() @ pose[:3, :3].T
    expected = np.where(rays[..., 2] < 0, -1.0 / np.minimum(rays[..., 2], -1e-9), np.inf)
    seen = frame.depth > 0
    assert seen.any() and np.allclose(frame.depth[seen], expected[seen], rtol=1e-5)
    assert (expected[~seen & (expected < 4)] < 0.3).all()


def test_a_ball_appears_at_its_projection_and_occludes_what_is_behind(yard):
    ball = Sphere("ball", planar_pose(1.5, 0.25, 0.9), 0.1, mass=1.0)
    with World(yard) as world:
        world.add_body(ball)
        camera = DepthCamera(world, T_link_camera=_looking([0.0, 0.0, 1.0]))
        frame = camera.render()
        k = frame.camera
        # World y is left of the image, world z up: u = cx - fx y / x, v = cy - fy z / x.
        u, v = round(k.cx - k.fx * 0.25 / 1.5), round(k.cy + k.fy * 0.1 / 1.5)
        assert frame.depth[v, u] == pytest.approx(1.4, abs=5e-3)
        assert frame.depth[v, u + 15] == pytest.approx(2.0, abs=1e-4)
        world.set_object_pose("ball", planar_pose(1.5, -0.25, 0.9))
        moved = camera.render()
        assert moved.depth[v, u] == pytest.approx(2.0, abs=1e-4)
        assert moved.depth[v, round(k.cx + k.fx * 0.25 / 1.5)] == pytest.approx(1.4, abs=5e-3)
        world.remove_body("ball")
        assert camera.render().depth.max() <= 5.0 and (camera.render().depth[v] > 1.99).all()
        world.add_body(Box("post", planar_pose(1.0, 0, 1.0), (0.2, 0.2, 0.4)))
        assert camera.render().depth[60, 80] == pytest.approx(0.9, abs=1e-4)
        world.set_object_pose("post", planar_pose(1.2, 0, 1.0))
        assert camera.render().depth[60, 80] == pytest.approx(1.1, abs=1e-4)


def test_what_moves_again_and_again_does_not_cost_the_scene_again(monkeypatch, yard):
    built = []
    monkeypatch.setattr(camera_module, "RayCaster", lambda mesh: built.append(mesh) or RayCaster(mesh))
    with World(yard) as world:
        world.add_body(Box("post", planar_pose(1.0, 0, 1.0), (0.2, 0.2, 0.4)))
        camera = DepthCamera(world, T_link_camera=_looking([0.0, 0.0, 1.0]))
        for x in (1.0, 1.2, 1.4, 1.6, 1.4):
            world.set_object_pose("post", planar_pose(x, 0, 1.0))
            assert camera.render().depth[60, 80] == pytest.approx(x - 0.1, abs=1e-4)
        assert len(built) <= 3, "the scene, the scene without the post, and the post"


@pytest.mark.parametrize("name", ["apartment", "office", "flat"])
def test_seen_points_lie_on_the_surfaces_of_the_ground_truth(name):
    scene = make_scene(name, 0)
    with World(scene) as world:
        field = world.field()
        x, y, _ = scene.start
        for yaw in np.arange(0, 2 * np.pi, 1.0):
            pose = _looking([x, y, 1.2], yaw=float(yaw), pitch=0.3)
            frame = DepthCamera(world, T_link_camera=pose, max_range=8.0).render()
            assert (frame.depth > 0).mean() > 0.5
            distance = field.distance(torch.tensor(frame.points()))
            assert distance.abs().max() < 1e-3


def test_culling_by_bounding_balls_changes_no_pixel():
    rng = np.random.default_rng(0)
    balls = [
        Sphere(
            f"b{i}",
            planar_pose(*rng.uniform([-1, -2, -1], [4, 2, 1])),
            float(rng.uniform(0.05, 0.3)),
            mass=1.0,
        )
        for i in range(40)
    ]
    fixed = tuple(Sphere(b.name, b.pose, b.radius) for b in balls)
    for pose in (_looking([0.0, 0.0, 0.0], 0.3, 0.2), _looking([-2.5, 1.0, 0.5], -0.4, 0.1)):
        depths = []
        for scene in (Scene("moving", objects=tuple(balls)), Scene("static", static=fixed)):
            with World(scene) as world:
                camera = DepthCamera(world, T_link_camera=pose, min_range=0.0)
                depths.append(camera.render().depth)
        # Seen from within a ball its inside is drawn either way; silhouettes may differ by rounding.
        assert (np.abs(depths[0] - depths[1]) > 1e-4).mean() < 1e-3


def test_the_robot_sees_its_arm_but_not_its_housing(yard, cart_urdf):
    with World(yard) as world:
        world.add_robot(cart_urdf, CART_JOINTS, [0.0, 0.0, 0.0, 0.0], head_joints=("pan_joint", "tilt_joint"))
        world.command_head(0.0, 0.6)
        world.step(1.0)
        camera = DepthCamera(world, link="optical")
        bare = DepthCamera(world, link="optical", see_robot=False)
        seen, without = camera.render(), bare.render()
        assert np.allclose(seen.T_world_camera, world.robot.link_pose("optical"))
        arm = (seen.depth > 0) & (seen.depth < without.depth - 0.05)
        assert arm.mean() > 0.01
        points = seen.points()[arm[seen.depth > 0]]
        # The arm's box spans x 0.1 to 0.5, its upper face is 0.83 m up.
        assert (points[:, 2] < 0.84).all() and (points[:, 2] > 0.5).all()
        assert (np.abs(points[points[:, 2] > 0.76][:, 1]) < 0.035).all()
        # The head's box surrounds the camera: with it the image would be empty.
        assert (seen.depth > 0).mean() > 0.9


def test_a_fixed_base_robot_is_drawn_where_it_stands(yard, cart_urdf):
    """The root link's frame is not at its centre of mass; the image must not shift by the offset."""
    from tests.robots.simulation.models import PANDA_JOINTS, PANDA_URDF

    with World(yard) as world:
        world.remove_body("wall")
        root = planar_pose(1.0, 0.0, 0.4)
        world.add_robot(PANDA_URDF, PANDA_JOINTS, [0, 0.3, 0, -2.0, 0, 2.3, 0.8], T_world_root=root)
        assert world.robot.link_pose("panda_link0") == pytest.approx(root, abs=1e-9)
        frame = DepthCamera(world, T_link_camera=_looking([-0.5, 0.0, 0.45])).render()
    # The pedestal's back is 0.14 m behind the root frame.
    assert frame.depth[60, 80] == pytest.approx(1.36, abs=0.02)


def test_ranges_and_rate(yard):
    with World(yard) as world:
        camera = DepthCamera(world, T_link_camera=_looking([0.0, 0.0, 1.0]), max_range=1.9, rate=10.0)
        assert camera.render().depth[60, 80] == 0.0
        near = DepthCamera(world, T_link_camera=_looking([1.8, 0.0, 1.0]))
        assert near.render().depth[60, 80] == 0.0
        frames = []
        for _ in range(240):
            frames.append(camera.capture())
            world.step()
        times = [frame.time for frame in frames if frame is not None]
        assert len(times) == 10 and np.diff(times) == pytest.approx(np.full(9, 0.1), abs=0.01)
        world.step(3.0)
        assert camera.capture() is not None and camera.capture() is None, "no burst after a pause"


def test_intrinsics():
    camera = PinholeCamera.from_fov(160, 120, float(np.radians(60)))
    edge = 2 * np.arctan((camera.width / 2) / camera.fx)
    assert edge == pytest.approx(np.radians(60)) and camera.fx == camera.fy
    assert camera.rays()[:, :, 2] == pytest.approx(np.ones((120, 160)))
    assert camera.rays().mean(axis=(0, 1)) == pytest.approx(np.array([0, 0, 1]), abs=1e-12)


def test_errors_name_what_is_wrong(yard, cart_urdf):
    with World(yard) as world:
        with pytest.raises(RobotError, match="min_range"):
            DepthCamera(world, min_range=2.0, max_range=1.0)
        with pytest.raises(RobotError, match="no robot yet"):
            DepthCamera(world, link="optical")
        world.add_robot(cart_urdf, CART_JOINTS, [0.0] * 4)
        with pytest.raises(UnknownLinkError, match=r"'optic'.*'optical'"):
            DepthCamera(world, link="optic")
        with pytest.raises(RobotError, match="fov"):
            PinholeCamera.from_fov(horizontal_fov=4.0)


@pytest.mark.skipif("ISDF_DATA_DIR" not in os.environ, reason="needs the shared data; set ISDF_DATA_DIR")
def test_a_house_of_concave_meshes_is_seen_from_inside():
    path = pathlib.Path(os.environ["ISDF_DATA_DIR"]) / "aws_small_house" / "small_house.urdf"
    if not path.is_file():
        pytest.skip(f"no {path}")
    import trimesh

    reference = trimesh.load_mesh(path.parent / "small_house_visual_world.ply")
    with World(load_urdf_scene(path)) as world:
        frame = DepthCamera(world, T_link_camera=_looking([0.0, 0.0, 1.2], pitch=0.2), max_range=8.0).render()
    assert (frame.depth > 0).mean() > 0.5
    points = frame.points()[::97]
    _, distance, _ = trimesh.proximity.closest_point_naive(reference, points[:20])
    assert distance.max() < 2e-3
