"""Objects of URDFs: their frame is the centre of mass, they fall, are seen, and stay out of the exact field."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from robots.errors import SceneError
from robots.simulation import Box, DepthCamera, PinholeCamera, Scene, SceneField, World, load_object
from robots.simulation.poses import looking, planar_pose

FLOOR = Box("floor", planar_pose(0.0, 0.0, -0.05), (4.0, 4.0, 0.1))
SIZE = (0.06, 0.1, 0.2)


@pytest.fixture
def carton(tmp_path: Path) -> Path:
    """A box mesh whose frame is at its bottom, and whose mass is 5 cm above that."""
    folder = tmp_path / "carton"
    folder.mkdir()
    trimesh.creation.box(extents=SIZE).apply_translation([0, 0, 0.1]).export(folder / "mesh.obj")
    shape = '<geometry><mesh filename="mesh.obj"/></geometry>'
    (folder / "model.urdf").write_text(
        '<robot name="carton"><link name="body"><inertial><origin xyz="0 0 0.05"/><mass value="0.3"/>'
        '<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>'
        f"<visual>{shape}</visual><collision>{shape}</collision></link></robot>"
    )
    return folder


def test_its_frame_is_its_centre_of_mass(carton: Path) -> None:
    thing = load_object(carton)
    assert thing.name == "carton" and thing.mass == pytest.approx(0.3)
    np.testing.assert_allclose(
        thing.local_mesh().bounds, [[-0.03, -0.05, -0.05], [0.03, 0.05, 0.15]], atol=1e-6
    )
    assert thing.parameters == pytest.approx(SIZE) and thing.bounding_radius == pytest.approx(0.161, abs=1e-3)
    at = thing.at(planar_pose(1.0, 0.0, 0.05, np.pi / 2))
    distance, gradient = at.distance_and_gradient(torch.tensor([[1.0, 0.0, 0.3], [1.15, 0.0, 0.1]]))
    np.testing.assert_allclose(distance, [0.1, 0.1], atol=1e-4)
    np.testing.assert_allclose(gradient, [[0, 0, 1], [1, 0, 0]], atol=1e-3)


def test_it_falls_stands_and_is_seen(carton: Path) -> None:
    thing = load_object(carton, "target").at(planar_pose(0.5, 0.2, 0.06, 0.3))
    with World(Scene("hall", (FLOOR,), (thing,))) as world:
        np.testing.assert_allclose(world.object_pose("target"), thing.pose, atol=1e-6)
        world.step(1.0)
        pose = world.object_pose("target")
        assert pose[2, 3] == pytest.approx(0.05, abs=0.003) and pose[2, 2] > 0.999
        np.testing.assert_allclose(pose[:2, 3], [0.5, 0.2], atol=0.005)
        camera = DepthCamera(
            world, PinholeCamera.from_fov(64, 48), T_link_camera=looking([0.5, 0.2, 1.2], [0.01, 0.0, -1.0])
        )
        assert camera.render().depth[24, 32] == pytest.approx(1.0, abs=0.01), "its top, not the floor"
        assert world.field().names == ("floor",)


def test_the_exact_field_leaves_it_out(carton: Path) -> None:
    thing = load_object(carton)
    assert SceneField((FLOOR, thing)).names == ("floor",)
    with pytest.raises(SceneError, match="at least one primitive"):
        SceneField((thing,))


def test_what_cannot_be_handled_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="folder with one, found 0"):
        load_object(tmp_path)
    path = tmp_path / "wall.urdf"
    path.write_text('<robot name="wall"><link name="body"/></robot>')
    with pytest.raises(SceneError, match="needs a mass"):
        load_object(path)
