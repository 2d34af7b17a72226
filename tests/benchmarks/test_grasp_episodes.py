"""The benchmark of grasps: its scenes, who takes turns, which contacts count, and its summary."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import robots
from benchmarks import grasp_episodes
from benchmarks.episodes import run_missing
from benchmarks.grasp_scenes import SUPPORTS, grasp_scene, shapes, thing_named, things
from benchmarks.recheck import recheck
from robots.simulation import World
from robots.simulation.recording import Recording


@pytest.mark.parametrize("support", SUPPORTS)
def test_things_stand_still_on_their_support_before_the_robot(support) -> None:
    scene = grasp_scene("flat", 3, support, thing_named("carton"))
    assert scene.grasp is not None and not [s.name for s in scene.static if s.name.startswith("grasp_table")]
    with World(scene) as world:
        before = {n: world.object_pose(n) for n in ("target", "left", "right")}
        world.step(1.0)
        for name, pose in before.items():
            after = world.object_pose(name)
            assert np.linalg.norm(after[:3, 3] - pose[:3, 3]) < 0.01, name
            assert after[2, 2] > 0.99, name
        x, y, heading = scene.grasp.park
        ahead = np.array([np.cos(heading), np.sin(heading)])
        away = before["target"][:2, 3] - np.array([x, y])
        assert 0.6 < away @ ahead < 0.7 and abs(away @ [-ahead[1], ahead[0]]) < 0.01


def test_all_things_take_turns_and_draws_repeat(tmp_path: Path) -> None:
    options = grasp_episodes.GraspThings(out=tmp_path, episodes=20)
    tasks = options.tasks()
    assert tasks == options.tasks()
    assert tasks != grasp_episodes.GraspThings(out=tmp_path, episodes=20, seed=1).tasks()
    counts = [sum(t.thing == name for t in tasks) for name in shapes()]
    assert min(counts) >= 2 and max(counts) <= 3
    assert {t.support for t in tasks} == set(SUPPORTS) and len({t.room for t in tasks}) == 3
    with pytest.raises(SystemExit, match="no object in it"):
        things(tmp_path)


def test_only_the_hand_may_touch_what_it_takes() -> None:
    touched = {
        "panda_leftfinger - target": 0.001,
        "arm_5_link - target": 0.002,
        "panda_hand - support.top": 0.01,
    }
    assert set(grasp_episodes.unwanted(touched)) == {"arm_5_link - target", "panda_hand - support.top"}


def test_results_say_which_thing_and_which_stage_lost(tmp_path: Path, monkeypatch, capsys) -> None:
    def pretend(task: grasp_episodes.GraspTaskOf) -> dict:
        if task.number == 1:
            raise RuntimeError("the simulator fell over")
        lifted = task.number != 2
        contacts = {"arm_4_link - left": 0.01} if task.number == 3 else {}
        return {
            "ended": "success" if lifted else "planning", "reason": "" if lifted else "no way", "lifted": lifted,
            "success": lifted and not contacts, "contacts": contacts, "contacts_rechecked": {},
        }  # fmt: skip

    monkeypatch.setattr(grasp_episodes.GraspTaskOf, "run", pretend)
    options = grasp_episodes.GraspThings(out=tmp_path, episodes=4)
    reports = run_missing(options)
    text = (tmp_path / "summary.md").read_text()
    assert "4 episodes, 2 lifted and held, 1 of these without any other contact" in text
    assert "error 1" in text and "planning 1" in text and "contact 1" in text
    assert f"episode 2 ({reports[2]['task']['thing']}, table): planning: no way" in text
    assert "touched arm_4_link - left" in text
    assert run_missing(options) == reports
    with pytest.raises(SystemExit, match=r"of another episode: its .*seed.* differ; choose another --out"):
        run_missing(dataclasses.replace(options, seed=1))
    capsys.readouterr()


def test_what_is_taken_may_touch_its_support_and_the_hand_only(tmp_path: Path) -> None:
    """The states of a thing that stands, and of one that is pushed into its neighbour."""
    scene = grasp_scene("flat", 3, "table", thing_named("carton"))
    model = robots.load("tiago")
    q = model.named["tucked"].double().numpy().copy()
    q[:3] = scene.grasp.park
    for name, pushed in (("standing", False), ("pushed", True)):
        with World(scene) as world:
            robot = world.add_robot(model.urdf_path, model.joint_names, q, gripper=model.gripper)
            recording = Recording(world)
            assert robot.body >= 0
            world.step(0.5)
            if pushed:
                beside = world.object_pose("left")
                beside[2, 3] = world.object_pose("target")[2, 3]
                beside[:2, 3] += 0.02
                world.set_object_pose("target", beside)
            recording.add()
            recording.save(tmp_path / f"{name}.npz")
    assert grasp_episodes.unwanted(recheck(scene, tmp_path / "standing.npz", watched="target")) == {}
    found = grasp_episodes.unwanted(recheck(scene, tmp_path / "pushed.npz", watched="target"))
    assert set(found) == {"target - left"}
