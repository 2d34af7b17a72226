"""The simulated robot as the closed loop sees it, with TIAGo."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import robots
from robots import RobotError
from robots.simulation import Box, DepthNoise, Scene, SimulatedMobileRobot, World
from robots.simulation.poses import planar_pose
from robots.simulation.rooms import can

FLOOR = Box("floor", planar_pose(0, 0, -0.05), (20.0, 20.0, 0.1))
WALL = Box("wall", planar_pose(2.1, 0, 1.0), (0.2, 6.0, 2.0))


@pytest.fixture(scope="module")
def tiago() -> robots.Robot:
    return robots.load("tiago")


@pytest.fixture
def put(tiago):
    """Puts TIAGo into a world of its own: put(*solids, pose, posture, ...)."""
    worlds = []

    def make(*static, pose=(0.0, 0.0, 0.0), posture="tucked", objects=(), **options) -> SimulatedMobileRobot:
        q = tiago.named[posture].double().numpy().copy()
        q[:3] = pose
        worlds.append(World(Scene("yard", static=(FLOOR, *static), objects=objects)))
        return SimulatedMobileRobot(worlds[-1], tiago, q, **options)

    yield make
    for world in worlds:
        world.close()


def off_axis(robot: SimulatedMobileRobot, point: np.ndarray) -> float:
    """Angle [rad] between the camera's axis and a point."""
    pose = robot.camera.pose()
    ray = point - pose[:3, 3]
    return float(np.arccos(pose[:3, 2] @ ray / np.linalg.norm(ray)))


@pytest.mark.parametrize("yaw", [0.0, 2.5, -2.9, 9.0])
def test_look_at_points_the_camera(put, yaw: float) -> None:
    robot = put(pose=(0.5, -0.3, yaw))
    for bearing, reach, height in ((0.0, 1.5, 0.3), (0.8, 2.0, 1.0), (-0.9, 2.0, 0.5), (0.4, 3.0, 1.9)):
        heading = yaw + bearing
        point = np.array([0.5 + reach * math.cos(heading), -0.3 + reach * math.sin(heading), height])
        robot.look_at(point)
        robot.wait(1.5)
        # The camera sits beside the neck's axes, which is worth some degrees on near points.
        assert math.degrees(off_axis(robot, point)) < 5.0
    np.testing.assert_allclose(robot.base_state(), (0.5, -0.3, yaw), atol=1e-3)


def test_look_at_goes_as_far_as_the_neck(put) -> None:
    robot = put()
    behind = np.array([-2.0, 0.5, 1.0])
    robot.look_at(behind)
    robot.wait(2.0)
    axis = robot.camera.pose()[:3, 2]
    assert math.atan2(axis[1], axis[0]) > 1.0, "turned to the left as far as it goes"
    assert off_axis(robot, behind) > 0.5


def test_recorded_states_tell_where_the_camera_was(put, tiago, tmp_path) -> None:
    robot, poses = put(pose=(0.5, -0.3, 0.4)), []
    for point in ((2.0, 0.9, 0.0), (1.5, -1.5, 1.1)):
        robot.look_at(np.array(point))
        robot.drive(0.1, 0.2, 1.0)
        poses.append(robot.camera.pose())
    robot.recording.save(tmp_path / "states.npz")
    with np.load(tmp_path / "states.npz") as saved:
        states = dict(saved)
    assert tuple(states["head_joints"]) == tiago.head_joints
    for q, head, pose in zip(states["joint_positions"], states["head_positions"], poses, strict=True):
        found = tiago.camera_pose(torch.as_tensor(q, dtype=torch.float32), head.tolist())
        np.testing.assert_allclose(found, pose, atol=1e-3)


def test_observe_leaves_nothing_of_the_robot(put, tiago) -> None:
    robot = put(posture="ready", pose=(0.3, 0.2, 0.7))
    robot.look_at(robot.world.robot.link_pose("panda_hand")[:3, 3])
    robot.wait(1.5)
    raw = robot.camera.render().points()
    assert (raw[:, 2] > 0.05).sum() > 500, "arm and hand are in view"
    frame = robot.observe()
    points = frame.points()
    assert len(points) > 5000
    # There is nothing but the floor and the robot, so all that is left must be floor.
    assert np.abs(points[:, 2]).max() < 0.01
    q = tiago.named["ready"].clone()
    q[:] = q.new_tensor(robot.posture())
    centres, radii = (t.double().numpy() for t in tiago.spheres(q))
    gaps = np.linalg.norm(points[:, None] - centres, axis=-1) - radii
    assert gaps.min() > robot.filter_margin - 1e-4


def test_observe_keeps_the_world(put) -> None:
    robot = put(WALL)
    robot.look_at(np.array([2.0, 0.0, 1.0]))
    robot.wait(1.5)
    frame = robot.observe()
    assert frame.time == robot.time
    np.testing.assert_array_equal(frame.T_world_camera, robot.camera.pose())
    points = frame.points()
    on_wall = points[points[:, 2] > 0.3]
    assert len(on_wall) > 0.5 * frame.depth.size
    np.testing.assert_allclose(on_wall[:, 0], 2.0, atol=1e-3)


def test_noise_is_repeatable_by_its_seed(put) -> None:
    def images(seed: int) -> np.ndarray:
        robot = put(WALL, noise=DepthNoise(), seed=seed)
        return np.stack([robot.observe().depth for _ in range(2)])

    first, same, other = images(0), images(0), images(1)
    np.testing.assert_array_equal(first, same)
    assert (first != other).any()
    assert (first[0] != first[1]).any(), "every image has noise of its own"
    exact = put(WALL).observe().depth
    error = np.abs(first[0] - exact)[(first[0] > 0) & (exact > 0)]
    assert 0 < np.median(error) < 0.05


def test_driving_moves_the_base_and_takes_time(put) -> None:
    robot = put(pose=(-1.0, 0.5, 0.4))
    assert robot.time == 0.0
    for _ in range(20):
        robot.drive(0.4, 0.0, 0.1)
    assert robot.time == pytest.approx(2.0, abs=0.01)
    x, y, yaw = robot.base_state()
    travelled = math.hypot(x + 1.0, y - 0.5)
    assert 0.6 < travelled < 0.8 and math.atan2(y - 0.5, x + 1.0) == pytest.approx(0.4, abs=0.01)
    assert yaw == pytest.approx(0.4, abs=0.01)
    for _ in range(20):
        robot.drive(0.0, 0.5, 0.1)
    assert robot.base_state()[2] == pytest.approx(0.4 + 1.0, abs=0.15)
    before = robot.base_state()
    robot.wait(0.5)
    robot.wait(1.0)
    assert np.linalg.norm(robot.base_state()[:2] - before[:2]) < 0.02
    assert robot.time == pytest.approx(5.5, abs=0.01)
    assert len(robot.recording) == 20 + 20 + 5 + 10


def test_the_recording_is_what_happened(put, tmp_path, tiago) -> None:
    cup = can("cup").at(planar_pose(0.0, 1.5, 0.06))
    robot = put(objects=(cup,))
    states, times = [], []
    for _ in range(6):
        robot.drive(0.3, 0.2, 0.1)
        states.append(robot.posture())
        times.append(robot.time)
    robot.recording.save(tmp_path / "states.npz")
    with np.load(tmp_path / "states.npz") as saved:
        assert set(saved) == {
            "time",
            "joint_names",
            "joint_positions",
            "object_names",
            "object_poses",
            "base_pose",
            "head_joints",
            "head_positions",
        }
        np.testing.assert_array_equal(saved["time"], times)
        np.testing.assert_array_equal(saved["joint_positions"], states)
        np.testing.assert_array_equal(saved["base_pose"], np.array(states)[:, :3])
        assert tuple(saved["joint_names"]) == tiago.joint_names
        assert list(saved["object_names"]) == ["cup"]
        assert saved["object_poses"].shape == (6, 1, 4, 4)
        np.testing.assert_array_equal(saved["object_poses"][-1, 0], robot.world.object_pose("cup"))
    np.testing.assert_array_equal(robot.recording.base_poses(), np.array(states)[:, :3])


def test_a_recording_without_objects_or_steps_can_be_saved(put, tmp_path) -> None:
    robot = put()
    assert robot.recording.base_poses().shape == (0, 3) and robot.recording.touched() == {}
    robot.recording.save(tmp_path / "none.npz")
    with np.load(tmp_path / "none.npz") as saved:
        assert saved["time"].shape == (0,) and saved["base_pose"].shape == (0, 3)
        assert saved["object_poses"].shape == (0, 0, 4, 4)


def test_touched_tells_what_was_pushed(put) -> None:
    robot = put(WALL, pose=(1.2, 0.0, 0.0))
    robot.drive(0.0, 0.0, 0.1)
    assert robot.recording.touched() == {}, "wheels on the floor are no contact"
    for _ in range(25):
        robot.drive(0.4, 0.0, 0.1)
    touched = robot.recording.touched()
    assert touched and all(pair.endswith(" - wall") for pair in touched)
    assert all(0 <= depth < 0.05 for depth in touched.values()) and max(touched.values()) > 0
    assert robot.recording.touched(ignore=("wall",)) == {}
    deepest = max(contact.depth for _, contact in robot.recording.contacts)
    assert max(touched.values()) == deepest
    for _ in range(20):
        robot.drive(-0.4, 0.0, 0.1)
    after = robot.recording.touched()
    assert after.keys() == touched.keys() and all(after[pair] >= touched[pair] for pair in touched)
    assert not robot.world.contacts(), "it has left the wall, but what once was touched stays so"


@pytest.mark.parametrize("lacks", ["base", "head", "camera"])
def test_a_robot_that_cannot_drive_and_look_is_refused(tiago, lacks: str) -> None:
    if lacks == "base":
        robot = tiago.with_fixed({"base_x": 0.0, "base_y": 0.0, "base_yaw": 0.0})
    else:
        robot = robots.Robot.from_urdf(
            tiago.urdf_path,
            tiago.sphere_set,
            joints=tiago.joint_names,
            tool_link="panda_hand_tcp",
            gripper=tiago.gripper,
            head_joints=() if lacks == "head" else tiago.head_joints,
            camera_link=None if lacks == "camera" else tiago.camera_link,
        )
    with World(Scene("yard", static=(FLOOR,))) as world:
        with pytest.raises(RobotError, match=lacks):
            SimulatedMobileRobot(world, robot, np.zeros(robot.num_dofs))
        assert not world.has_robot, "the world is left as it was"


def test_a_fixed_arm_is_refused() -> None:
    panda = robots.load("panda")
    with World(Scene("yard", static=(FLOOR,))) as world, pytest.raises(RobotError, match="panda"):
        SimulatedMobileRobot(world, panda, panda.rest.double().numpy())
