"""Composed URDFs: they load from anywhere, keep geometry and inertia, and refuse what cannot fit."""

from __future__ import annotations

import math
import os
import stat
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import torch

import robots
from robots.kinematic_tree import KinematicTree
from robots.mesh_paths import example_robot_data, resolve_mesh

ARM = """<robot name="arm"><link name="base"><inertial><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link><link name="hand"/>
<joint name="wrist" type="revolute"><parent link="base"/><child link="hand"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="2"/></joint><transmission name="t"/></robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_compose_keeps_inertia_and_drops_extensions(arm: Path) -> None:
    text = robots.compose(arm).read_text()
    root = ElementTree.fromstring(text)
    masses = {
        link.get("name"): float(link.find("inertial/mass").get("value")) for link in root.findall("link")
    }
    assert masses["base"] == 2.0
    assert masses["hand"] < 0.01  # a frame without inertia must not weigh a kilogram
    assert root.find("transmission") is None


def test_an_inertia_no_body_can_have_is_replaced(tmp_path: Path) -> None:
    for bad in (
        'ixx="1" ixy="2" ixz="0" iyy="1" iyz="0" izz="1"',
        'ixx="9" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"',
    ):
        path = tmp_path / "bad.urdf"
        path.write_text(ARM.replace('ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"', bad))
        inertia = ElementTree.fromstring(robots.compose(path).read_text()).find("link/inertial/inertia")
        moments = [float(inertia.get(k)) for k in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")]
        trace = sum(float(word.split('"')[1]) for word in bad.split() if word[:3] in ("ixx", "iyy", "izz"))
        assert moments == pytest.approx([trace / 3] * 3 + [0.0] * 3)


def test_planar_base_comes_first_and_moves_everything(arm: Path) -> None:
    tree = KinematicTree.from_urdf(robots.compose(arm, planar_base=robots.PlanarBase(velocity=0.7)))
    assert tree.movable_joints == ("base_x", "base_y", "base_yaw", "wrist")
    assert tree.joint("base_x").velocity == 0.7
    assert tree.link_transforms({"base_x": 3.0, "base_y": -2.0})["hand"][:2, 3].tolist() == [3.0, -2.0]


def test_attachments_are_placed_and_prefixed(arm: Path) -> None:
    mounted = robots.Attachment(arm, "hand", "base", xyz=(0.0, 0.0, 0.5), prefix="second_")
    tree = KinematicTree.from_urdf(robots.compose(arm, [mounted]))
    assert tree.movable_joints == ("wrist", "second_wrist")
    assert tree.link_transforms({})["second_hand"][2, 3] == 0.5


def test_name_clashes_and_missing_links_are_refused(arm: Path) -> None:
    with pytest.raises(robots.UrdfError, match="prefix"):
        robots.compose(arm, [robots.Attachment(arm, "hand", "base")])
    with pytest.raises(robots.UnknownLinkError, match="hand"):
        robots.compose(arm, [robots.Attachment(arm, "flange", "base", prefix="x_")])
    with pytest.raises(robots.UrdfError, match="extract_subtree"):
        robots.compose(arm, [robots.Attachment(arm, "hand", "hand", prefix="x_")])


def test_extract_subtree_takes_only_what_hangs_below(arm: Path) -> None:
    panda = example_robot_data() / "panda_description" / "urdf" / "panda.urdf"
    hand = KinematicTree.from_urdf(robots.extract_subtree(panda, "panda_hand"))
    assert set(hand.links) == {"panda_hand", "panda_hand_tcp", "panda_leftfinger", "panda_rightfinger"}
    assert hand.root == "panda_hand"
    with pytest.raises(robots.UnknownLinkError, match="panda_link3"):
        robots.extract_subtree(panda, "elbow")


def test_cache_is_keyed_by_content_and_readable_by_others(arm: Path, own_cache: Path) -> None:
    first = robots.compose(arm)
    assert first == robots.compose(arm)
    assert own_cache in first.parents
    assert first != robots.compose(arm, planar_base=True)
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(first.stat().st_mode) == 0o666 & ~umask
    assert not [path for path in first.parent.iterdir() if path.suffix != ".urdf"]  # no temporary files stay


def test_output_path_is_respected(arm: Path, tmp_path: Path) -> None:
    assert robots.compose(arm, output=tmp_path / "out.urdf") == tmp_path / "out.urdf"
    assert KinematicTree.from_urdf(tmp_path / "out.urdf").name == "arm"


def test_mesh_uris_are_resolved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = tmp_path / "ws" / "my_robot" / "meshes" / "a.stl"
    mesh.parent.mkdir(parents=True)
    mesh.touch()
    urdf = tmp_path / "elsewhere" / "r.urdf"
    with pytest.raises(robots.UrdfError, match="ROS_PACKAGE_PATH"):
        resolve_mesh("package://my_robot/meshes/a.stl", urdf)
    for entry in (tmp_path / "ws", tmp_path / "ws" / "my_robot"):
        monkeypatch.setenv("ROS_PACKAGE_PATH", str(entry))
        assert resolve_mesh("package://my_robot/meshes/a.stl", urdf) == mesh
    assert resolve_mesh("package://my_robot/meshes/a.stl", mesh.parents[1] / "urdf" / "r.urdf") == mesh
    assert resolve_mesh("meshes/a.stl", mesh.parents[1] / "r.urdf") == mesh


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "well-formed"),
        ("<sdf/>", "<robot>"),
        ('<robot name="r"><link name="a"/><link name="b"/></robot>', "one tree"),
        (ARM.replace('child link="hand"', 'child link="paw"'), "'paw'"),
        (ARM.replace('type="revolute"', 'type="floating"'), "floating"),
        (ARM.replace('xyz="0 0 1"', 'xyz="0 0 0"'), "zero axis"),
        (ARM.replace('lower="-1"', 'lower="2"'), "above upper"),
        (ARM.replace('lower="-1"', 'lower="one"'), "'one'.*'wrist'"),
        (ARM.replace('velocity="2"', 'velocity="nan"'), "NaN"),
        (ARM.replace('xyz="0 0 1"', 'xyz="0 1"'), "three numbers"),
        (ARM.replace("<axis", '<mimic joint="thumb"/><axis'), "mimics 'thumb'.*movable ones"),
        (ARM.replace("<axis", '<mimic joint="wrist"/><axis'), "circle"),
    ],
)
def test_malformed_urdfs_are_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.urdf"
    path.write_text(text)
    with pytest.raises(robots.UrdfError, match=message):
        KinematicTree.from_urdf(path)


def test_missing_urdf_is_explained(tmp_path: Path) -> None:
    with pytest.raises(robots.UrdfError, match=r"nothing\.urdf"):
        robots.compose(tmp_path / "nothing.urdf")


JOINT = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><axis xyz="0 0 1"/>{4}</joint>'


def test_every_kind_of_joint_moves_as_the_urdf_says(tmp_path: Path) -> None:
    path = tmp_path / "kinds.urdf"
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    path.write_text(
        '<robot name="kinds">'
        + "".join(f'<link name="{name}"/>' for name in "abcd")
        + JOINT.format("spin", "continuous", "a", "b", '<limit effort="1" velocity="2"/>')
        + JOINT.format("slide", "prismatic", "b", "c", limit)
        + JOINT.format("follow", "revolute", "c", "d", limit + '<mimic joint="spin" multiplier="0.5"/>')
        + "</robot>"
    )
    robot = robots.Robot.from_urdf(path, robots.SphereSet({"d": np.array([[1.0, 0.0, 0.0, 0.1]])}))
    assert robot.joint_names == ("spin", "slide")
    assert robot.joint_limits.tolist() == [[-math.inf, math.inf], [-1.0, 1.0]]
    q = torch.tensor(
        [2 * math.pi + 1.0, 0.3], dtype=torch.float64
    )  # a continuous joint may turn more than once
    angle = 1.5 * (2 * math.pi + 1.0)
    expected = [math.cos(angle), math.sin(angle), 0.3]
    assert robot.spheres(q)[0][0].tolist() == pytest.approx(expected, abs=1e-6)
    with pytest.raises(robots.UnknownJointError, match="mimics"):
        robots.Robot.from_urdf(path, robot.sphere_set, joints=("follow",))
    with pytest.raises(robots.UnknownJointError, match=r"thumb.*spin"):
        robots.Robot.from_urdf(path, robot.sphere_set, joints=("thumb",))
