"""Record a depth sequence: the robot drives through a furnished room along ways it is told are free.

    python -m examples.record --out runs/recorded --scene office --seed 0
    isdf map runs/recorded --out runs/recorded_map --cpu-per-second 1.0

Writes the recorded-sequence folder (depth/, poses.txt, intrinsics.json) that `isdf map` reads.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tqdm import tqdm

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from examples.camera_tour import CameraTour, Leg
from examples.episode import Episode, EpisodeOptions
from isdf.datasets import SequenceWriter


@dataclass(frozen=True)
class Record(EpisodeOptions):
    """Record posed depth images of a drive through a room."""

    goals: int = 3
    """How many of the scene's goals to visit."""


def main(options: Record) -> int:
    """Drive and write; returns the number of frames."""
    torch.set_num_threads(1)
    episode = Episode(options)
    if not episode.scene.goals:
        raise SystemExit(f"{options.scene} has no goals to visit; choose apartment, office, flat or a home")

    def shoot() -> None:
        frame = episode.robot.observe()
        writer.write(frame.depth, frame.T_world_camera)

    tour = CameraTour(episode, shoot)
    writer = SequenceWriter(options.out, episode.robot.camera.camera, fps=tour.fps)
    for goal in tqdm(episode.scene.goals[: options.goals], desc="recording", unit=" goal", disable=None):
        tour.drive(Leg((goal[:2],)))
    episode.close()
    return writer.count


if __name__ == "__main__":
    print(f"{main(tyro.cli(Record))} frames")
