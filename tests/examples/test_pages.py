"""Every numbered example runs, and what it leaves shows what it says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import isdf
from examples import (
    e01_fit_field,
    e02_compare_methods,
    e03_plan_arm,
    e04_fit_spheres,
    e05_mesh_truth,
    e06_background,
    e07_live_source,
    e08_navigate,
    e09_grasp,
    e10_whole_body,
)
from isdf.datasets import SequenceWriter
from planning.drive import DriveStatus
from tests.isdf.rooms import furnished_orbit, furnished_room

ROOT = Path(__file__).parents[2]
URDF = """<robot name="two_boxes">
<link name="base"><collision><geometry><box size="0.3 0.2 0.1"/></geometry></collision></link>
<link name="arm"><collision><origin xyz="0 0 0.2"/><geometry><box size="0.05 0.05 0.4"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture(autouse=True, scope="module")
def _keep_threads():
    """The examples set the number of threads of the whole process."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> Path:
    frames, folder = furnished_orbit(12), tmp_path_factory.mktemp("room")
    writer = SequenceWriter(folder, frames[0].camera, fps=10.0)
    for frame in frames:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    return folder


def assert_shows_something(path: Path) -> None:
    with Image.open(path) as picture:
        assert min(picture.size) > 250 and np.asarray(picture.convert("L")).std() > 6


def test_there_are_ten_on_a_page_each_and_their_commands_are_their_own() -> None:
    pages = sorted((ROOT / "examples").glob("e[0-9][0-9]_*.py"))
    assert [int(page.name[1:3]) for page in pages] == list(range(1, 11))
    for page in pages:
        text = page.read_text()
        assert 50 <= len(text.splitlines()) <= 130, page.name
        assert (
            text.startswith(f'"""{int(page.name[1:3])}. ') and "\ndef main(" in text and "tyro.cli(" in text
        )
        commands = re.findall(r"^    python -m examples\.(\w+)", text, flags=re.MULTILINE)
        assert page.stem in commands and all((ROOT / "examples" / f"{name}.py").exists() for name in commands)


def test_01_fits_a_field(sequence, tmp_path, capsys) -> None:
    field = e01_fit_field.main(e01_fit_field.FitField(sequence, tmp_path / "out", every=2))
    said = capsys.readouterr().out
    assert "<Mapper: 6 frames" in said and said.count("m to the nearest surface") == 2
    surface = furnished_orbit(12)[0].thinned(4, 4.0)
    assert field.distance(surface).abs().median() < 0.03
    assert_shows_something(tmp_path / "out" / "slice.png")
    vertices = torch.from_numpy(np.asarray(trimesh.load(tmp_path / "out" / "mesh.ply").vertices)).float()
    seen = field.confidence(vertices) > 0.5
    assert furnished_room()(vertices[seen]).abs().median() < 0.03
    assert isdf.load_map(tmp_path / "out" / "map.safetensors").frames_seen == 6


def test_02_compares_methods(sequence, tmp_path, capsys) -> None:
    options = e02_compare_methods.CompareMethods(sequence, tmp_path / "out", ("default", "exact"), 5.0, 300)
    scores = e02_compare_methods.main(options)
    assert list(scores) == ["default", "exact"] and capsys.readouterr().out.count(" cm") >= 2
    assert all(score.median_error < 0.05 and score.within > 0.6 for score in scores.values())
    assert_shows_something(tmp_path / "out" / "slices.png")
    with pytest.raises(SystemExit, match="choose from default, isdf"):
        e02_compare_methods.main(e02_compare_methods.CompareMethods(sequence, tmp_path, ("best",)))


def test_03_plans_an_arm_round_what_was_mapped(tmp_path, capsys) -> None:
    result = e03_plan_arm.main(e03_plan_arm.PlanArm(tmp_path / "out", views=8))
    said = capsys.readouterr().out
    assert result.success and result.clearance >= 0.02
    assert "straight line: collision" in said and "in the true scene: success" in said
    for name in ("joints.png", "slice.png"):
        assert_shows_something(tmp_path / "out" / name)


@pytest.mark.slow
def test_04_makes_a_robot_of_spheres(tmp_path, capsys) -> None:
    (tmp_path / "r.urdf").write_text(URDF)
    options = e04_fit_spheres.FitSpheres(tmp_path / "r.urdf", tmp_path / "out" / "s.yaml", 12, 10)
    robot = e04_fit_spheres.main(options)
    said = capsys.readouterr().out
    assert robot.joint_names == ("turn",) and len(robot.sphere_links) <= 12
    assert "<PlanResult: success" in said and "10 random configurations" in said and "NOT SAFE" not in said
    assert_shows_something(tmp_path / "out" / "s.png")


def test_05_measures_meshes(tmp_path, capsys) -> None:
    trimesh.creation.box((1000.0, 1000.0, 500.0)).export(tmp_path / "block.stl")
    options = e05_mesh_truth.MeshTruth(tmp_path / "block.stl", tmp_path / "out", scale=0.001)
    field = e05_mesh_truth.main(options)
    assert float(field.distance(torch.tensor([0.0, 0.0, 0.5]))) == pytest.approx(0.25)
    assert "off by" in capsys.readouterr().out
    assert_shows_something(tmp_path / "out" / "slice.png")
    (tmp_path / "r.urdf").write_text(URDF)
    e05_mesh_truth.main(e05_mesh_truth.MeshTruth(tmp_path / "r.urdf", tmp_path / "out"))
    e05_mesh_truth.main(e05_mesh_truth.MeshTruth(None, tmp_path / "out"))
    assert "<PlanResult: success" in capsys.readouterr().out


def test_06_plans_while_mapping(sequence, capsys) -> None:
    rates = e06_background.main(e06_background.Background(sequence, speed=2.0, planners=2))
    said = capsys.readouterr().out
    assert rates.received == 12 == rates.used + rates.dropped and rates.snapshots >= 2
    assert "the last: <PlanResult: success" in said


def test_07_maps_from_a_live_camera(tmp_path, capsys) -> None:
    snapshot = e07_live_source.main(e07_live_source.LiveMap(tmp_path / "out", "office", fps=2.0, seconds=4.0))
    assert snapshot.frames >= 3 and "<SimulatedCamera simulated camera" in capsys.readouterr().out
    assert isdf.load_map(tmp_path / "out" / "map.safetensors").frames_seen == snapshot.frames
    assert_shows_something(tmp_path / "out" / "slice.png")


@pytest.mark.slow
def test_08_drives(tmp_path, capsys) -> None:
    options = e08_navigate.Drive(tmp_path / "out", "office", 1, fixed_cost=True, time_limit=120.0)
    report = e08_navigate.main(options)
    assert report.status is DriveStatus.REACHED and report.plans >= 1 and report.path_length > 0.5
    assert "contacts: none" in capsys.readouterr().out
    assert_shows_something(tmp_path / "out" / "way.png")
    assert np.load(tmp_path / "out" / "states.npz")["base_pose"].shape[1] == 3


@pytest.mark.slow
def test_09_lifts(tmp_path, capsys) -> None:
    assert e09_grasp.main(e09_grasp.LiftObject(tmp_path / "out", looks=6)) > 0.1
    assert "contacts with anything else: none" in capsys.readouterr().out
    assert_shows_something(tmp_path / "out" / "slice.png")
    (tmp_path / "hall.urdf").write_text('<robot name="hall"><link name="floor"/></robot>')
    with pytest.raises(SystemExit, match="no object to grasp"):
        e09_grasp.main(e09_grasp.LiftObject(tmp_path, str(tmp_path / "hall.urdf")))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["default", "truth"])
def test_10_drives_and_reaches_on_wheels(tmp_path, capsys, method) -> None:
    assert e10_whole_body.main(e10_whole_body.WholeBody(tmp_path, method=method))
    said = capsys.readouterr().out
    assert "in the true scene: success" in said and "contacts none" in said
    for name in ("joints.png", "way.png", "strip.png"):
        assert_shows_something(tmp_path / name)
    assert Image.open(tmp_path / "strip.png").size == (1600, 300), "from the start to the goal in four photos"
