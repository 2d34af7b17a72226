"""The two examples end to end, in the simulator, at fixed costs so that they do the same on every machine.

What a report claims is checked against the recorded states of the physics.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from examples import grasp, navigate
from examples.episode import Episode, EpisodeOptions
from robots.errors import SceneError
from robots.simulation import make_scene

SCENE, SEED = "office", 1
GRASP_SCENE, GRASP_SEED = "flat", 0


@pytest.fixture(autouse=True, scope="module")
def _keep_threads():
    """The examples set the number of threads of the whole process."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def drive_across(out: Path) -> dict:
    return navigate.main(navigate.Navigate(out, scene=SCENE, seed=SEED, fixed_cost=True, film=False))


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("navigate")
    return drive_across(out), out


@pytest.fixture(scope="module")
def lift(tmp_path_factory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("grasp")
    options = grasp.GraspOptions(out, scene=GRASP_SCENE, seed=GRASP_SEED, fixed_cost=True, film=False)
    return grasp.main(options), out


def states(out: Path) -> dict[str, np.ndarray]:
    with np.load(out / "states.npz") as saved:
        return dict(saved)


def assert_complete(report: dict, out: Path) -> None:
    """The folder holds the report, consistent states and a picture."""
    assert json.loads((out / "report.json").read_text()) == json.loads(json.dumps(report))
    saved = states(out)
    n = len(saved["time"])
    assert n > 100 and (np.diff(saved["time"]) > 0).all()
    assert saved["base_pose"].shape == (n, 3)
    assert saved["joint_positions"].shape == (n, len(saved["joint_names"]))
    assert saved["object_poses"].shape == (n, len(saved["object_names"]), 4, 4)
    assert all(np.isfinite(saved[key]).all() for key in ("time", "joint_positions", "object_poses"))
    for name in ("map.png", "summary.png"):
        with Image.open(out / name) as picture:
            picture.load()
            assert min(picture.size) > 300
            assert np.asarray(picture.convert("L")).std() > 10, "the picture shows something"
    assert "summary.png" in (out / "report.html").read_text()
    assert (out / "map.safetensors").stat().st_size > 10_000
    assert not (out / "episode.gif").exists()


def test_navigation_reaches_the_goal_without_contact(drive) -> None:
    report, out = drive
    assert report["success"] is True
    assert report["contacts"] == 0 and report["contact_pairs"] == {}
    assert_complete(report, out)
    assert {
        "example",
        "scene",
        "seed",
        "success",
        "contacts",
        "straight_line",
        "goal",
        "drive",
        "map",
    } <= set(report)
    assert report["drive"]["status"] == "reached"
    assert report["map"]["method"] == "default" and report["map"]["steps"] > 20
    assert report["map"]["sdf_error"]["mean"] < 0.12
    assert (out / "mesh.ply").stat().st_size > 10_000


def test_the_navigation_report_agrees_with_the_states(drive) -> None:
    report, out = drive
    saved, scene = states(out), make_scene(SCENE, SEED)
    assert scene.start is not None and scene.goal is not None
    base = saved["base_pose"]
    np.testing.assert_allclose(base[0, :2], scene.start[:2], atol=0.05)
    np.testing.assert_allclose(report["goal"], scene.goal[:2])
    assert np.linalg.norm(base[-1, :2] - scene.goal[:2]) < 0.1
    steps = np.linalg.norm(np.diff(base[:, :2], axis=0), axis=1)
    assert steps.sum() == pytest.approx(report["drive"]["path_length"], abs=0.1)
    assert report["straight_line"] < steps.sum() < 3 * report["straight_line"]
    assert (steps <= 0.65 * np.diff(saved["time"]) + 1e-3).all(), "the base keeps to its speed"
    assert saved["time"][-1] == pytest.approx(report["drive"]["duration"], abs=0.2)
    joints = saved["joint_positions"][:, 3:]
    assert np.abs(joints - joints[0]).max() < 0.05, "the arm stays tucked"


def test_the_drive_takes_the_time_that_computing_was_charged(drive) -> None:
    told = drive[0]["drive"]
    assert told["duration"] == pytest.approx(told["mapping_seconds"] + told["planning_seconds"], abs=0.5)


@pytest.mark.slow
def test_navigation_at_fixed_cost_repeats_exactly(drive, tmp_path) -> None:
    report, out = drive
    again = drive_across(tmp_path)
    first, second = states(out), states(tmp_path)
    assert first.keys() == second.keys()
    for key, values in first.items():
        np.testing.assert_array_equal(values, second[key], err_msg=key)
    for key in ("success", "contacts", "goal", "map"):
        assert report[key] == again[key]


def test_the_grasp_lifts_the_object_and_touches_nothing_else(lift) -> None:
    report, out = lift
    assert report["success"] is True and report["ended"] == "success"
    assert report["contacts"] == 0 and report["contact_pairs"] == {}
    assert_complete(report, out)
    assert {
        "lift_height",
        "held_seconds",
        "drive",
        "planning_seconds",
        "reason",
        "map",
        "robot_seconds",
    } <= set(report)
    assert report["lift_height"] >= grasp.LIFTED and report["held_seconds"] == grasp.HELD_FOR


def test_the_grasp_report_agrees_with_the_states(lift) -> None:
    _, out = lift
    saved, task = states(out), make_scene(GRASP_SCENE, GRASP_SEED).grasp
    assert task is not None
    height = saved["object_poses"][:, list(saved["object_names"]).index(task.object_name), 2, 3]
    held = saved["time"] >= saved["time"][-1] - grasp.HELD_FOR + 0.05
    assert held.sum() >= 10
    assert height[held].min() - height[0] >= grasp.LIFTED - 0.01
    thing = saved["object_poses"][0, list(saved["object_names"]).index(task.object_name), :2, 3]
    assert 0.5 < np.linalg.norm(saved["base_pose"][-1, :2] - thing) < 0.95, "parked within the arm's reach"
    others = [i for i, name in enumerate(saved["object_names"]) if name != task.object_name]
    places = saved["object_poses"][10:, :, :3, 3][:, others]  # after they have settled
    assert np.linalg.norm(places - places[0], axis=-1).max(initial=0.0) < 0.02, "nothing else was moved"


def test_an_unknown_scene_is_refused_with_the_names_there_are(tmp_path) -> None:
    with pytest.raises(SceneError, match=r"'castle'.*apartment"):
        Episode(EpisodeOptions(tmp_path, scene="castle"))
    with pytest.raises(SceneError, match=r"no URDF at .*castle\.urdf"):
        Episode(EpisodeOptions(tmp_path, scene="castle.urdf"))


def test_a_scene_without_a_goal_asks_for_one(tmp_path) -> None:
    (tmp_path / "hall.urdf").write_text('<robot name="hall"><link name="floor"/></robot>')
    options = navigate.Navigate(tmp_path, scene=str(tmp_path / "hall.urdf"), film=False)
    with pytest.raises(SystemExit, match="--start"):
        navigate.main(options)
