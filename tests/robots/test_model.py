"""Forward kinematics against pybullet, differentiability, limits, and what bad input is told."""

from __future__ import annotations

import importlib.metadata
import math

import numpy as np
import pybullet
import pytest
import torch

import robots
from robots.kinematic_tree import KinematicTree
from tests.gradients import assert_gradient_matches


@pytest.fixture(scope="module", params=["tiago", "panda", "ur5"])
def robot(request: pytest.FixtureRequest) -> robots.Robot:
    return robots.load(request.param)


@pytest.fixture(scope="module")
def tiago() -> robots.Robot:
    return robots.load("tiago")


def random_configurations(robot: robots.Robot, count: int, seed: int = 0) -> torch.Tensor:
    lower, upper = robot.joint_limits.clamp(-2.0, 2.0).unbind(-1)
    return lower + (upper - lower) * torch.rand(
        count, robot.num_dofs, generator=torch.Generator().manual_seed(seed)
    )


def pybullet_poses(robot: robots.Robot, q: torch.Tensor, links: tuple[str, ...]) -> np.ndarray:
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(robot.urdf_path), useFixedBase=True, physicsClientId=client)
        count = pybullet.getNumJoints(body, physicsClientId=client)
        infos = [pybullet.getJointInfo(body, i, physicsClientId=client) for i in range(count)]
        joint_index = {info[1].decode(): info[0] for info in infos}
        link_index = {info[12].decode(): info[0] for info in infos}
        for name, value in robot.joint_values(q).items():
            pybullet.resetJointState(body, joint_index[name], value, physicsClientId=client)
        poses = []
        for link in links:
            state = pybullet.getLinkState(
                body, link_index[link], computeForwardKinematics=True, physicsClientId=client
            )
            pose = np.eye(4)
            pose[:3, :3] = np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))
            pose[:3, 3] = state[4]
            poses.append(pose)
        return np.stack(poses)
    finally:
        pybullet.disconnect(client)


def test_link_poses_agree_with_pybullet(robot: robots.Robot) -> None:
    links = tuple(link for link in robot.tree.links if link != robot.tree.root)
    for q in random_configurations(robot, 3):
        ours = robot.link_poses(q, links).numpy()
        assert np.abs(ours - pybullet_poses(robot, q, links)).max() < 1e-4


def test_batched_poses_agree_with_the_reference_tree(robot: robots.Robot) -> None:
    q = random_configurations(robot, 6, seed=3).double().reshape(2, 3, -1)
    links = robot.tree.links
    poses = robot.link_poses(q, links)
    assert poses.shape == (2, 3, len(links), 4, 4)
    expected = robot.tree.link_transforms(robot.joint_values(q[1, 2]))
    for link, pose in zip(links, poses[1, 2], strict=True):
        np.testing.assert_allclose(pose.numpy(), expected[link], atol=2e-6, err_msg=link)


def test_spheres_move_with_their_links(robot: robots.Robot) -> None:
    q = random_configurations(robot, 4, seed=1)
    centres, radii = robot.spheres(q)
    rows = torch.as_tensor(np.concatenate(list(robot.sphere_set.spheres.values()))).float()
    poses = robot.link_poses(q, robot.sphere_links)
    expected = (poses[..., :3, :3] @ rows[:, :3, None]).squeeze(-1) + poses[..., :3, 3]
    torch.testing.assert_close(centres, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(radii, rows[:, 3])


def test_sphere_gradient(robot: robots.Robot) -> None:
    generator = torch.Generator().manual_seed(2)
    q = random_configurations(robot, 2, seed=5)
    weight = torch.randn(2, len(robot.sphere_links), 3, generator=generator, dtype=torch.float64)

    def value(x: torch.Tensor) -> torch.Tensor:
        return (robot.spheres(x)[0] * weight).sum()

    def gradient(x: torch.Tensor) -> torch.Tensor:
        x = x.clone().requires_grad_()
        return torch.autograd.grad(value(x), x)[0]

    assert_gradient_matches(value, gradient, q)


def test_limits_match_the_urdf(robot: robots.Robot) -> None:
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(str(robot.urdf_path), useFixedBase=True, physicsClientId=client)
    seen = 0
    for i in range(pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getJointInfo(body, i, physicsClientId=client)
        name, lower, upper, velocity = info[1].decode(), info[8], info[9], info[11]
        if name in robot.joint_names:
            seen += 1
            k = robot.joint_names.index(name)
            assert robot.velocity_limits[k].item() == pytest.approx(velocity)
            if name == "base_yaw":
                assert robot.joint_limits[k].tolist() == [-math.inf, math.inf]
            else:
                assert robot.joint_limits[k].tolist() == pytest.approx([lower, upper])
    pybullet.disconnect(client)
    assert seen == robot.num_dofs


def test_tiago_moves_its_base_in_the_world(tiago: robots.Robot) -> None:
    assert tiago.joint_names[:3] == ("base_x", "base_y", "base_yaw")
    q = tiago.rest.clone()
    q[:3] = torch.tensor([2.0, -1.0, math.pi / 2])
    pose = tiago.link_poses(q, ["base_footprint"])[0]
    expected = torch.tensor([[0.0, -1, 0, 2], [1, 0, 0, -1], [0, 0, 1, 0], [0, 0, 0, 1]])
    torch.testing.assert_close(pose, expected, atol=1e-6, rtol=0)


def test_camera_looks_forward_and_follows_the_head(tiago: robots.Robot) -> None:
    level = tiago.camera_pose(tiago.rest, head=(0.0, 0.0))
    np.testing.assert_allclose(level[:3, 2], [1, 0, 0], atol=1e-6)  # z forward
    np.testing.assert_allclose(level[:3, 1], [0, 0, -1], atol=1e-6)  # y down
    assert 0.9 < level[2, 3] < 1.4
    left = tiago.camera_pose(tiago.rest, head=(0.5, 0.0))
    np.testing.assert_allclose(left[:3, 2], [math.cos(0.5), math.sin(0.5), 0], atol=1e-6)
    assert tiago.camera_pose(tiago.rest, head=(0.0, -0.4))[2, 2] < -0.3  # negative tilt looks down
    with pytest.raises(robots.RobotError, match="head_1_joint"):
        tiago.camera_pose(tiago.rest, head=(0.0,))


def test_with_fixed_gives_the_same_spheres(tiago: robots.Robot) -> None:
    q = random_configurations(tiago, 1, seed=7)[0]
    base = dict(zip(tiago.joint_names[:4], q[:4].tolist(), strict=True))
    arm = tiago.with_fixed(base)
    assert arm.joint_names == tiago.joint_names[4:]
    torch.testing.assert_close(arm.spheres(q[4:])[0], tiago.spheres(q)[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(arm.named["ready"], tiago.named["ready"][4:])
    assert len(arm.self_collision_pairs) <= len(tiago.self_collision_pairs)
    open_hand = tiago.spheres(q)[0]
    closed_hand = tiago.with_fixed({"panda_finger_joint1": 0.0}).spheres(q)[0]
    moved = (open_hand - closed_hand).norm(dim=-1) > 1e-3
    assert {tiago.sphere_links[i] for i in moved.nonzero().flatten()} == {
        "panda_leftfinger",
        "panda_rightfinger",
    }


def test_self_collision_pairs_are_sound(robot: robots.Robot) -> None:
    pairs = robot.self_collision_pairs
    assert 0 < len(pairs) < 15_000
    neighbours = robot.tree.neighbours(robot.sphere_set.spheres)
    for i, j in pairs.tolist():
        names = frozenset((robot.sphere_links[i], robot.sphere_links[j]))
        assert len(names) == 2 and names not in neighbours


def test_named_postures_are_free_of_self_collision(robot: robots.Robot) -> None:
    for name, q in robot.named.items():
        centres, radii = robot.spheres(q)
        i, j = robot.self_collision_pairs.unbind(-1)
        gap = (centres[i] - centres[j]).norm(dim=-1) - radii[i] - radii[j]
        assert gap.min() > 0, name
        lower, upper = robot.joint_limits.unbind(-1)
        assert (q >= lower).all() and (q <= upper).all(), name


def test_tucked_arm_stays_within_the_footprint(tiago: robots.Robot) -> None:
    q = tiago.named["tucked"]
    centres, radii = tiago.spheres(q)
    reach = centres[:, :2].norm(dim=-1) + radii
    footprint = reach[tiago.floor_spheres].max()
    assert reach.max() < footprint + 0.05
    # No sphere of the arm stands in the middle of the camera's view when it looks ahead and slightly down.
    camera = np.linalg.inv(tiago.camera_pose(q, head=(0.0, -0.3)))
    local = centres.double().numpy() @ camera[:3, :3].T + camera[:3, 3]
    arm = np.array([link.startswith(("arm", "wrist", "panda")) for link in tiago.sphere_links])
    ahead = local[arm & (local[:, 2] > 0)]
    assert (np.abs(ahead[:, 1] / ahead[:, 2]) > math.tan(math.radians(15))).all()


def test_floor_spheres_are_low_and_hardly_below_the_floor(tiago: robots.Robot) -> None:
    centres, radii = tiago.spheres(tiago.rest)
    bottom = centres[:, 2] - radii
    assert bottom.min() > -0.02
    assert tiago.floor_spheres.any()
    assert bottom[~tiago.floor_spheres].min() > 0.1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_q(tiago: robots.Robot, dtype: torch.dtype) -> None:
    centres, radii = tiago.spheres(tiago.rest.to(dtype))
    assert centres.dtype == radii.dtype == dtype


def test_bad_configurations_are_named(tiago: robots.Robot) -> None:
    with pytest.raises(robots.RobotError, match=r"expected \(..., 11\)"):
        tiago.spheres(torch.zeros(7))
    q = tiago.rest.clone()
    q[4] = torch.nan
    with pytest.raises(robots.RobotError, match="arm_1_joint"):
        tiago.spheres(q)


def test_unknown_names_are_answered_with_the_valid_ones(tiago: robots.Robot) -> None:
    with pytest.raises(robots.UnknownLinkError, match="arm_3_link"):
        tiago.link_poses(tiago.rest, ["elbow"])
    with pytest.raises(robots.UnknownJointError, match="arm_3_joint"):
        tiago.with_fixed({"elbow": 0.0})
    with pytest.raises(robots.UnknownRobotError, match="fetch, panda, tiago, ur5"):
        robots.load("r2d2")


def test_velocity_limit_has_a_documented_default(tmp_path, caplog: pytest.LogCaptureFixture) -> None:
    urdf = tmp_path / "slider.urdf"
    urdf.write_text(
        '<robot name="slider"><link name="a"/><link name="b"/><joint name="slide" type="prismatic">'
        '<parent link="a"/><child link="b"/><limit lower="0" upper="1" effort="1" velocity="0"/></joint></robot>'
    )
    slider = robots.Robot.from_urdf(urdf, robots.SphereSet({"b": np.array([[0.0, 0, 0, 0.1]])}))
    assert slider.velocity_limits.tolist() == pytest.approx([0.1])
    assert "slide" in caplog.text


def test_mimicking_joints_follow(tmp_path) -> None:
    urdf = tmp_path / "mimic.urdf"
    joint = (
        '<joint name="{0}" type="{3}"><parent link="{1}"/><child link="{2}"/><axis xyz="0 0 1"/>{4}</joint>'
    )
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    urdf.write_text(
        '<robot name="m"><link name="a"/><link name="b"/><link name="c"/>'
        + joint.format("lead", "a", "b", "prismatic", limit)
        + joint.format(
            "follow", "a", "c", "prismatic", limit + '<mimic joint="lead" multiplier="-2" offset="0.5"/>'
        )
        + "</robot>"
    )
    robot = robots.Robot.from_urdf(urdf, robots.SphereSet({"c": np.array([[0.0, 0, 0, 0.1]])}))
    assert robot.joint_names == ("lead",)
    assert robot.spheres(torch.tensor([0.3]))[0][0].tolist() == pytest.approx([0, 0, 0.5 - 0.6])
    assert KinematicTree.from_urdf(urdf).movable_joints == ("lead",)


def test_the_fetch_has_motionbenchmakers_joint_order() -> None:
    try:
        fetch = robots.load("fetch")
    except robots.RobotError as error:
        pytest.skip(f"no Fetch: {error}")
    arm = (
        "shoulder_pan",
        "shoulder_lift",
        "upperarm_roll",
        "elbow_flex",
        "forearm_roll",
        "wrist_flex",
        "wrist_roll",
    )
    assert fetch.joint_names == ("torso_lift_joint", *(f"{joint}_joint" for joint in arm))
    q = random_configurations(fetch, 1)[0]
    links = tuple(link for link in fetch.tree.links if link != fetch.tree.root)
    assert np.abs(fetch.link_poses(q, links).numpy() - pybullet_poses(fetch, q, links)).max() < 1e-4


def test_a_missing_robot_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "files", missing)
    with pytest.raises(robots.RobotError, match=r"fetch-planning is not installed.*isdf-planning\[fetch\]"):
        robots.load("fetch")
