from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from robots.errors import SceneError, UrdfError
from robots.simulation import DepthCamera, MeshField, SceneField, World, load_urdf_scene, make_scene
from tests.gradients import assert_gradient_matches

RNG = np.random.default_rng(4)
BOX = trimesh.creation.box((1.0, 0.6, 0.4))
TURN = trimesh.transformations.rotation_matrix(0.7, [0.2, 1.0, -0.4], point=[0.1, 0.0, 0.0])


def _around(bounds: torch.Tensor, n: int, margin: float = 0.5) -> torch.Tensor:
    """Points (n, 3) in a box grown by a margin [m], float64."""
    unit = torch.rand(n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return bounds[0] - margin + (bounds[1] - bounds[0] + 2 * margin) * unit


def _box_distance(points: torch.Tensor, size: tuple[float, float, float]) -> torch.Tensor:
    q = points.abs() - torch.tensor(size, dtype=torch.float64) / 2
    return q.clamp(min=0).norm(dim=-1) + q.amax(dim=-1).clamp(max=0)


def test_a_box_of_triangles_has_the_closed_form_of_a_box_however_it_stands():
    local = _around(torch.tensor([[-0.5, -0.3, -0.2], [0.5, 0.3, 0.2]]), 4000)
    T = torch.tensor(TURN)
    points = local @ T[:3, :3].T + T[:3, 3]
    distance = MeshField(BOX.copy().apply_transform(TURN)).distance(points)
    assert (distance < 0).any()
    torch.testing.assert_close(distance, _box_distance(local, (1.0, 0.6, 0.4)), rtol=0, atol=1e-9)


def test_a_room_of_overlapping_pieces_has_the_distances_of_its_primitives():
    scene = make_scene("flat", 1)
    solids = [s for s in (*scene.static, *scene.objects) if s.kind == "box"]
    field, truth = MeshField(s.mesh() for s in solids), SceneField(solids)
    points = _around(field.bounds, 4000, 0.1)
    torch.testing.assert_close(field.distance(points), truth.distance(points), rtol=0, atol=1e-7)


def test_the_gradient_is_unit_and_agrees_with_finite_differences_and_autograd():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.4).apply_translation([0.6, 0.1, 0.2])
    field = MeshField([BOX, ball])
    points = _around(field.bounds, 60)
    assert_gradient_matches(
        lambda x: field.distance(x).sum(), lambda x: field.distance_and_gradient(x)[1], points
    )
    points.requires_grad_()
    (automatic,) = torch.autograd.grad(field.distance(points).square().sum(), points)
    distance, gradient = field.distance_and_gradient(points)
    assert not distance.requires_grad
    torch.testing.assert_close(automatic, 2 * distance[:, None] * gradient)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(60, dtype=torch.float64))


def test_on_the_surface_the_gradient_is_the_normal():
    field = MeshField(BOX)
    distance, gradient = field.distance_and_gradient(torch.tensor([[0.13, 0.05, 0.2]], dtype=torch.float64))
    assert abs(float(distance)) < 1e-12
    torch.testing.assert_close(gradient, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))


def test_triangles_that_face_inwards_make_a_room():
    shell = trimesh.creation.box((4.0, 3.0, 2.5))
    shell.invert()
    beyond = BOX.copy().apply_translation([6.0, 0.0, 0.0])  # nearer to the last point, but in the rock
    field = MeshField([shell, BOX, beyond])
    points = torch.tensor([[1.6, 0.0, 0.0], [0.0, 0.0, 0.1], [5.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(
        field.distance(points), torch.tensor([0.4, -0.1, -3.0], dtype=torch.float64), rtol=0, atol=1e-9
    )


def test_a_sheet_with_a_rim_is_outside_where_it_faces():
    floor = trimesh.Trimesh([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], [[0, 1, 2], [0, 2, 3]])
    points = torch.tensor([[0.3, 0.1, 0.7], [0.3, 0.1, -0.7], [3.0, 0.0, 0.0]])
    torch.testing.assert_close(MeshField(floor).distance(points).abs(), torch.tensor([0.7, 0.7, 1.0]))
    assert (MeshField(floor).distance(points[:2]) > 0).tolist() == [True, False]


def test_files_and_urdfs_give_the_field_of_their_meshes(tmp_path):
    up = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    BOX.export(tmp_path / "box.ply")
    trimesh.Scene([BOX.copy().apply_scale(1000).apply_transform(np.linalg.inv(up))]).export(
        tmp_path / "box.glb"
    )
    points = _around(MeshField(BOX).bounds, 500)
    wanted = MeshField(BOX).distance(points)
    torch.testing.assert_close(
        MeshField.read(tmp_path / "box.ply").distance(points), wanted, rtol=0, atol=1e-6
    )
    turned = MeshField.read(tmp_path / "box.glb", T_world_mesh=up, scale=0.001)
    torch.testing.assert_close(turned.distance(points), wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("concave", ["yes", "no"])
def test_a_urdf_scene_is_measured_where_the_simulated_camera_sees_it(tmp_path, concave):
    """A corner of two walls: as it is the camera looks into it, as a hull it is filled."""
    walls = [trimesh.creation.box((2.0, 0.1, 2.0)), trimesh.creation.box((0.1, 2.0, 2.0))]
    walls[0].apply_translation([0.0, 1.0, 0.0])
    walls[1].apply_translation([1.0, 0.0, 0.0])
    trimesh.util.concatenate(walls).export(tmp_path / "corner.obj")
    mesh = '<geometry><mesh filename="corner.obj"/></geometry>'
    urdf = tmp_path / "corner.urdf"
    urdf.write_text(
        f'<robot name="corner"><link name="base"/><joint name="j" type="fixed"><parent link="base"/>'
        f'<child link="wall"/><origin xyz="0.5 0 0.3"/></joint><link name="wall"><visual>{mesh}</visual>'
        f'<collision concave="{concave}">{mesh}</collision></link></robot>'
    )
    field = MeshField.from_urdf(urdf)
    with World(load_urdf_scene(urdf)) as world:
        pose = np.eye(4)
        pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        pose[:3, 3] = [-0.5, 0.3, 0.2]
        frame = DepthCamera(world, T_link_camera=pose).capture()
    seen = field.distance(torch.tensor(frame.points()))
    assert len(seen) > 1000
    if concave == "yes":
        assert float(seen.abs().max()) < 1e-4
    else:
        assert float(seen.median()) < -0.09  # the hull closes the corner


def test_what_is_no_mesh_is_refused(tmp_path):
    with pytest.raises(SceneError, match="at least one triangle"):
        MeshField([])
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(SceneError, match="positive area"):
        MeshField(flat)
    broken = BOX.copy()
    broken.vertices[0] = np.nan
    with pytest.raises(SceneError, match="finite"):
        MeshField(broken)
    for name, content in (("none.ply", None), ("text.ply", b"no mesh"), ("scene.xyzzy", b"")):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(SceneError, match=name):
            MeshField.read(tmp_path / name)
    with pytest.raises(UrdfError):
        MeshField.from_urdf(tmp_path / "none.urdf")
    with pytest.raises(SceneError, match="NaN"):
        MeshField(BOX).distance(torch.tensor([[np.nan, 0.0, 0.0]]))
