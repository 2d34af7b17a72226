"""Watching episodes: what is shown and recorded of them, and in a headless Chromium a goal that is dragged."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("viser")

from examples import grasp
from examples.episode import Episode, EpisodeOptions
from examples.live import Live, LiveOptions
from isdf.viewer import Recording, Viewer
from planning.clock import MeasuredClock
from planning.replanning import ReplanningConfig, ReplanningLoop
from tests.browser import drag, on_screen, page_of, wait

ROOT = Path(__file__).parents[2]
LOOK = ReplanningConfig(scan=0.5, time_limit=60.0)


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def watched_episode(folder: Path, **live) -> Episode:
    return Episode(EpisodeOptions(folder, "office", 1, fixed_cost=True, live=LiveOptions(**live)))


def loop_in(episode: Episode, watch) -> ReplanningLoop:
    return ReplanningLoop(
        episode.robot,
        episode.body,
        episode.mapper,
        episode.field_for_driving,
        LOOK,
        episode.clock(),
        watch,
        monitor=episode.monitor,
        footprint=episode.spheres,
    )


REPLAY = """
import sys
sys.modules.update(dict.fromkeys(("pybullet", "robots", "planning", "examples")))
sys.argv = ["isdf", "view", sys.argv[1], "--port", "0", "--seconds", "0.5"]
import isdf.cli
isdf.cli.main()
"""
"""Plays a recording where neither a simulator nor a robot can be imported."""


class Enough(Exception):
    """Ends a drive early."""


def test_an_episode_is_recorded_with_robot_map_plan_and_way(tmp_path) -> None:
    episode, followed = watched_episode(tmp_path, record=tmp_path / "film"), []

    def watch(loop: ReplanningLoop) -> None:
        episode.live.follow(loop, goal_moves=True)
        followed.append(loop.plan)
        if loop.leads_to_goal and len(followed) > 4 and all(plan is loop.plan for plan in followed[-4:]):
            raise Enough

    loop = loop_in(episode, watch)
    with pytest.raises(Enough):
        loop.drive_to(np.array(episode.scene.goal[:2]))
    centres, _ = episode.spheres()
    posture, plan = episode.robot.posture(), loop.plan.trajectory.waypoints.numpy()
    episode.close()
    recording = Recording(tmp_path / "film")
    assert np.diff(recording.times).max() < 0.3 and recording.times[-1] > 3.8
    last = recording.state(len(recording) - 1)
    assert np.abs(last.spheres["spheres"].centres - centres).max() < 0.2
    assert np.abs(last.lines["plan"].points[:, :2] - plan).max() < 1e-5
    assert np.linalg.norm(last.lines["driven"].points[-1, :2] - posture[:2]) < 0.1
    assert last.field is not None and last.frame.depth.max() > 0.5
    assert np.allclose(last.goal, episode.scene.goal[:2]) and "to the goal" in last.status
    shown = [name for name in last.shapes if name.startswith("robot/")]
    assert len(shown) > 10 and all(name in last.poses for name in shown)
    base = last.poses["robot/2"][:2, 3] if "robot/2" in last.poses else posture[:2]
    assert np.linalg.norm(base - posture[:2]) < 0.5
    assert sum(name.startswith("things/") for name in last.shapes) >= 1
    replayed = subprocess.run(
        [sys.executable, "-c", REPLAY, tmp_path / "film"], cwd=ROOT, capture_output=True, text=True
    )
    assert replayed.returncode == 0 and f"recording of {len(recording)} states" in replayed.stdout, (
        replayed.stderr
    )


def test_an_episode_that_nobody_watches_makes_nothing_of_it(tmp_path) -> None:
    episode = watched_episode(tmp_path)
    assert not episode.live.active and episode.robot.disturbances[-1] is episode.live
    episode.robot.drive(0.1, 0.0, 0.1)
    episode.live.say("unheard")
    assert not episode.live._way and not episode.live._links
    goal = np.zeros(2)
    assert episode.live.moved_goal(goal) is goal
    episode.close()


def test_drawing_is_not_charged_to_the_robot(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(Viewer, "cpu_seconds", lambda self: time.process_time() - 5.0)
    episode = Episode(EpisodeOptions(tmp_path, "office", 1, live=LiveOptions(viewer=True, viewer_port=0)))
    clock = episode.clock()
    assert isinstance(clock, MeasuredClock)
    _, spent = clock.charge(lambda: sum(i * i for i in range(200_000)))
    assert spent == pytest.approx(0.0, abs=1e-3), "as if the viewer had done all of it"
    episode.close()


def test_the_grasps_point_and_ways_are_drawn_for_who_watches(tmp_path) -> None:
    options = grasp.GraspOptions(
        tmp_path, scene="flat", fixed_cost=True, film=False, live=LiveOptions(record=tmp_path)
    )
    grasping = grasp.GraspEpisode(options)
    episode, live = grasping.episode, grasping.episode.live
    q = torch.as_tensor(episode.robot.posture(), dtype=torch.float32)
    live.look_closely(episode.world.field(), grasping.point)
    live.reach([q[None, 3:].repeat(3, 1)])
    live.say("grasping")
    episode.close()
    last = Recording(tmp_path)
    state = last.state(len(last) - 1)
    assert state.status == "grasping" and np.allclose(state.goal, grasping.point)
    assert len(state.shapes["close map"].faces) > 100
    tool = episode.model.link_poses(q, [episode.model.tool_link])[0, :3, 3]
    assert np.allclose(state.lines["reach"].points, tool.numpy(), atol=1e-3)


def test_after_a_drive_the_robot_drives_on_to_where_the_goal_is_dragged() -> None:
    dragged, driven = [None, np.array([1.0, 2.0]), None, np.array([3.0, 4.0])], []

    class Watched:
        @property
        def watched(self) -> bool:
            return bool(dragged)

        controls = SimpleNamespace(take_goal=lambda: dragged.pop(0))

    def drive_to(goal: np.ndarray) -> SimpleNamespace:
        driven.append(goal.tolist())
        return SimpleNamespace(message="the base stands on the goal")

    live = Live(LiveOptions(), SimpleNamespace(), SimpleNamespace(), SimpleNamespace())
    loop = SimpleNamespace(drive_to=drive_to, watch=None)
    live.drive_on(loop)
    assert not driven, "nobody watches"
    live.viewer = Watched()
    live.drive_on(loop)
    assert driven == [[1.0, 2.0], [3.0, 4.0]] and loop.watch is not None


def test_dragging_the_goal_in_the_browser_makes_the_loop_plan_to_where_it_was_dropped(tmp_path) -> None:
    episode = watched_episode(tmp_path, viewer=True, viewer_port=0)
    viewer, ended = episode.live.viewer, threading.Event()

    def watch(loop: ReplanningLoop) -> None:
        episode.live.follow(loop, goal_moves=True)
        if ended.is_set():
            raise Enough

    loop = loop_in(episode, watch)
    first = np.array(episode.scene.goal[:2])

    def drive() -> None:
        with pytest.raises(Enough):
            loop.drive_to(first)

    with page_of(viewer.url) as (page, errors):
        wait(page, lambda: viewer.watched)
        driving = threading.Thread(target=drive)
        driving.start()
        try:
            wait(page, lambda: loop.report.plans >= 1 and "goal" in viewer.stage._handles)
            viewer.controls.pause()
            for layer in ("map", "robot", "spheres", "things"):  # a browser that draws in software is slow
                viewer.stage.set_visible(layer, False)
            page.wait_for_timeout(1500)
            x, y = loop.goal
            start, end = (on_screen(viewer, page, np.array([x + dx, y, 0.0])) for dx in (0.45, -0.35))
            drag(page, start, end)
            wait(page, lambda: viewer.controls._goal is not None)
            plans = loop.report.plans
            page.get_by_text("Play", exact=True).click()
            wait(page, lambda: loop.report.plans > plans and loop.plan is not None)
            assert loop.goal[0] == pytest.approx(first[0] - 0.8, abs=0.25)
            assert loop.goal[1] == pytest.approx(first[1], abs=1e-6), "along the arrow that was dragged"
            event = f"the goal is now {loop.goal[0]:.2f}, {loop.goal[1]:.2f}"
            assert any(event in line for line in loop.report.events)
            assert not errors, errors
        finally:
            viewer.controls.play()
            ended.set()
            driving.join(timeout=30.0)
    episode.close()
