"""8. The closed loop on one page: sense, map, plan, follow, until the goal is reached.

    python -m examples.e08_navigate --out runs/e08 --scene office --seed 3

Leaves states.npz and way.png. `examples.navigate` is the same with a report, a film, and more to choose.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm import tqdm

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import isdf
from examples.episode import Episode, EpisodeOptions
from planning.drive import DriveReport
from planning.replanning import ReplanningConfig, ReplanningLoop


@dataclass(frozen=True)
class Drive(EpisodeOptions):
    """Map an unknown furnished room and drive to a goal in it."""

    time_limit: float = 180.0
    """Of the robot's time [s]."""


def main(options: Drive) -> DriveReport:
    """Drive; returns what happened."""
    torch.set_num_threads(1)
    episode = Episode(options)
    if episode.scene.goal is None:
        raise SystemExit(f"{options.scene} has no goal of its own; `examples.navigate` takes --goal X Y")
    goal = np.array(episode.scene.goal[:2])
    with tqdm(desc="driving", unit=" rounds", disable=None) as bar:

        def watch(loop: ReplanningLoop) -> None:
            episode.live.follow(loop, goal_moves=True)  # with --viewer: drag the goal
            left = np.linalg.norm(episode.robot.base_state()[:2] - loop.goal)
            bar.set_postfix_str(f"t = {episode.robot.time:.0f} s, {left:.1f} m to go")
            bar.update()

        loop = ReplanningLoop(
            episode.robot,  # senses and drives
            episode.body,  # its spheres at every heading
            episode.mapper,  # learns from the frames
            episode.field_for_driving,  # what is planned in
            ReplanningConfig(time_limit=options.time_limit),
            episode.clock(),  # what computing costs the robot in time
            watch,
            monitor=episode.monitor,  # has the last word on every command
            footprint=episode.spheres,  # no camera sees where its own robot is
        )
        report = loop.drive_to(goal)
    print(
        f"{report.status.value}: {report.path_length:.1f} m in {report.duration:.0f} s, {report.plans} plans"
    )
    print(f"contacts: {episode.contacts() or 'none'}; {episode.mapper}")

    options.out.mkdir(parents=True, exist_ok=True)
    episode.robot.recording.save(options.out / "states.npz")
    figure = isdf.plot_slice(episode.mapper.field(), 0.5, bounds=episode.mapper.bounds)
    driven = episode.robot.recording.base_poses()
    axes = figure.axes[0]
    axes.plot(driven[:, 0], driven[:, 1], color="red")
    axes.plot(*loop.goal, "*", color="gold", markersize=14, markeredgecolor="black")
    figure.savefig(options.out / "way.png")
    episode.close()
    return report


if __name__ == "__main__":
    chosen = tyro.cli(Drive, description=__doc__)
    raise SystemExit(0 if main(chosen).success else 1)
