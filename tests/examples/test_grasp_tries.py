"""A hand that comes up empty: it feels it, draws back, looks anew and tries again, and not for ever."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from examples import grasp
from examples.arm import clearance, parked, within_limits
from examples.episode import Episode, EpisodeOptions
from examples.grasp_stages import (
    LIFT,
    draw_back,
    field_for_reaching,
    heights_to_look_from,
    holds_nothing,
    own_space,
    raise_torso,
)
from robots.simulation import make_scene


def pretended(monkeypatch, heights: list[float], felt_empty: bool = True) -> SimpleNamespace:
    """An episode whose lifts reach some heights [m], and what it did."""
    did = SimpleNamespace(looks=0, lifts=0)

    def take(*_) -> float:
        did.lifts += 1
        return heights[did.lifts - 1]

    def look(*_) -> SimpleNamespace:
        did.looks += 1
        return SimpleNamespace()

    monkeypatch.setattr(grasp, "take", take)
    monkeypatch.setattr(grasp, "CloseLook", look)
    monkeypatch.setattr(grasp, "holds_nothing", lambda *_: felt_empty)
    monkeypatch.setattr(grasp, "draw_back", lambda *_: True)
    episode = grasp.GraspEpisode.__new__(grasp.GraspEpisode)
    episode.episode = SimpleNamespace(robot=SimpleNamespace(posture=lambda: np.zeros(3)))
    episode.task = SimpleNamespace(object_name="target")
    episode.bar = SimpleNamespace(set_description=lambda *_: None)
    episode.film = SimpleNamespace(add=lambda *_: None, close_up=None)
    episode.options = SimpleNamespace(margin=0.02, seed=0)
    episode.point, episode.clock, episode.tries, episode.reason = np.zeros(3), None, 0, "no place"
    episode.plan, episode.show = lambda: (None, None), lambda *_: None
    did.ended = episode.grasp_from_here()
    did.episode = episode
    return did


def test_an_empty_hand_looks_anew_and_tries_again(monkeypatch) -> None:
    did = pretended(monkeypatch, [0.0, 0.14])
    assert did.ended == "success" and did.episode.reason == ""
    assert did.lifts == did.episode.tries == 2 and did.looks == 1


def test_it_gives_up_after_some_tries_and_when_something_is_held(monkeypatch) -> None:
    did = pretended(monkeypatch, [0.0] * 10)
    assert did.ended == "lift" and did.lifts == grasp.TRIES
    did = pretended(monkeypatch, [0.05] * 10, felt_empty=False)
    assert did.ended == "lift" and did.lifts == 1 and "not high enough" in did.episode.reason


def test_the_hand_feels_itself_and_the_arm_draws_back(tmp_path: Path) -> None:
    task = make_scene("flat", 0).grasp
    assert task is not None
    episode = Episode(EpisodeOptions(tmp_path, scene="flat", noise=False), task.park)
    robot, lift = episode.robot, episode.model.joint_names.index(LIFT)
    robot.look_at(np.array([task.park[0] + np.cos(task.park[2]), task.park[1] + np.sin(task.park[2]), 0.7]))
    robot.wait(0.5)
    episode.mapper.integrate(robot.observe())
    tucked = robot.posture()
    heights = heights_to_look_from(episode)
    assert heights[0] == pytest.approx(tucked[lift], abs=0.005) and np.all(np.diff(heights) > 0.02)
    raise_torso(episode, heights[-1])
    assert robot.posture()[lift] == pytest.approx(heights[-1], abs=0.005)
    lower = torch.as_tensor(robot.posture(), dtype=torch.float32).repeat(9, 1)
    lower[:, lift] = torch.linspace(float(tucked[lift]), heights[-1], 9)
    balls, sizes = episode.model.spheres(lower)
    torso = torch.tensor([link.startswith("torso") for link in episode.model.sphere_links])
    centres, radii = own_space(episode)
    deep = (radii - torch.cdist(balls[:, torso].reshape(-1, 3), centres)).amax(dim=1)
    assert bool((deep > sizes[torso].repeat(9) - 0.02).all()), "it may sink again"
    arm, posture = parked(episode.model, tucked)
    room = clearance(arm, within_limits(arm, posture)[None], field_for_reaching(episode))
    assert room > 0.03, (
        "the base, which stands still, does not let the arm come nearer to things than its margin"
    )
    assert not holds_nothing(episode)
    robot.world.command_gripper(0.0, 30.0)
    robot.wait(1.0)
    assert holds_nothing(episode)
    assert draw_back(episode, tucked, 0.02, 0)
    assert not holds_nothing(episode)
    np.testing.assert_allclose(robot.posture()[lift:], tucked[lift:], atol=0.01)
    episode.close()
