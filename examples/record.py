"""Record a depth sequence: the robot drives through a furnished room along ways it is told are free.

    python -m examples.record --out runs/recorded --scene office --seed 0
    isdf map runs/recorded --out runs/recorded_map --cpu-per-second 1.0

Writes the recorded-sequence folder (depth/, poses.txt, intrinsics.json) that `isdf map` reads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import tyro
from tqdm import tqdm

from examples.episode import Episode, EpisodeOptions
from isdf.datasets import SequenceWriter
from planning.grid_search import GridSearchConfig, grid_search
from planning.tracking import BaseTracker


@dataclass(frozen=True)
class Record(EpisodeOptions):
    """Record posed depth images of a drive through a room."""

    goals: int = 3
    """How many of the scene's goals to visit."""


def main(options: Record) -> int:
    """Drive and write; returns the number of frames."""
    torch.set_num_threads(1)
    episode = Episode(options)
    robot, tracker = episode.robot, BaseTracker()
    if not episode.scene.goals:
        raise SystemExit(f"{options.scene} has no goals to visit; choose apartment, office or flat")
    period = tracker.config.period
    writer = SequenceWriter(options.out, robot.camera.camera, fps=1 / period)
    field = episode.world.field()
    for goal in tqdm(episode.scene.goals[: options.goals], desc="recording", unit=" goal", disable=None):
        here = torch.as_tensor(robot.base_state()[:2], dtype=torch.float32)
        route = grid_search(episode.body, field, here, torch.tensor(goal[:2]), GridSearchConfig(margin=0.3))
        path = route.path.numpy().astype(float)
        tracker.reset()
        while not tracker.finished:
            state = robot.base_state()
            # Sway the head as a robot does that watches its way.
            sway = state[2] + 0.6 * np.sin(0.8 * robot.time)
            robot.look_at(np.array([state[0] + 1.5 * np.cos(sway), state[1] + 1.5 * np.sin(sway), 0.5]))
            robot.drive(*tracker.command(state, path), period)
            frame = robot.observe()
            writer.write(frame.depth, frame.T_world_camera)
    episode.close()
    return writer.count


if __name__ == "__main__":
    print(f"{main(tyro.cli(Record))} frames")
