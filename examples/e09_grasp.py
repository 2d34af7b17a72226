"""9. Reach through a map: parked before a table, look closely at what somebody points at, find a grasp, lift.

    python -m examples.e09_grasp --out runs/e09 --scene flat --seed 0

Given is a point on the object, as a click in the camera's image gives it. The grasp comes from the map: two faces of
its zero level set that look away from each other, with room for the hand. Leaves slice.png. `examples.grasp` also
drives up to the table, and writes a report.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import isdf
from examples.episode import Episode, EpisodeOptions, chosen_scene
from examples.grasp_stages import LIFTED, CloseLook, choose_grasp, take
from examples.pointing import click_on


@dataclass(frozen=True)
class LiftObject(EpisodeOptions):
    """Map a table and lift an object off it."""

    scene: str = "flat"
    """A furnished room with a grasp task: apartment, office or flat."""
    looks: int = 12
    """Depth images of the table."""
    margin: float = 0.02
    """Clearance the arm keeps in the map where start and goal allow it [m]."""


def main(options: LiftObject) -> float:
    """Look, choose, take; returns by how much the object was lifted [m]."""
    torch.set_num_threads(1)
    task = chosen_scene(options).grasp
    if task is None:
        raise SystemExit(f"{options.scene} has no object to grasp; choose apartment, office or flat")
    episode = Episode(options, task.park)
    point = click_on(episode.world, task.object_name, np.array([*task.park[:2], 1.2]), options.seed)
    point = episode.live.moved_goal(point)  # with --viewer it can be dragged
    episode.live.say("looking closely")
    close = CloseLook(episode, point, episode.clock())
    close.look(options.looks)
    options.out.mkdir(parents=True, exist_ok=True)
    around = torch.as_tensor(np.stack([point - 0.2, point + 0.2]), dtype=torch.float32)
    isdf.plot_slice(close.mapper.field(), float(point[2]), bounds=around, spacing=0.004).savefig(
        options.out / "slice.png"
    )

    point = close.point = episode.live.moved_goal(point)
    episode.live.look_closely(close.mapper.field(), point)
    episode.live.say("choosing a grasp")
    chosen = choose_grasp(episode, close, options.margin, options.seed)
    if isinstance(chosen, str):
        print(chosen)
        return 0.0
    episode.live.reach([chosen[1], chosen[0].approach, chosen[0].lift])
    episode.live.say("grasping")
    lifted = take(episode, *chosen, task.object_name)
    touched = episode.robot.recording.touched(ignore=(task.object_name,))
    print(f"lifted {100 * lifted:.0f} cm; contacts with anything else: {touched or 'none'}")
    episode.close()
    return lifted


if __name__ == "__main__":
    raise SystemExit(0 if main(tyro.cli(LiftObject, description=__doc__)) > LIFTED else 1)
