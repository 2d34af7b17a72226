"""Record synthetic sequences like the paper's: three furnished homes, each explored, looked at, and reached into.

    python -m examples.record_sequences --out runs/sequences
    python -m examples.record_sequences --out runs/sequences --only apt_1_nav apt_2_mnp

Each is a recorded-sequence folder that `isdf map` reads, with noisy depth; `noise_free/` in it is the same with exact
depth, and `truth.json` the exact solids. What is finished is not recorded again; what was interrupted starts anew.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm import tqdm

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from examples.camera_tour import CameraTour
from examples.episode import Episode, EpisodeOptions
from examples.home_tours import TOURS, HomeTour
from isdf.datasets import RecordedSequence, SequenceWriter
from robots.simulation import DepthCamera, DepthNoise, DepthNoiseConfig, PinholeCamera, save_truth

MAX_RANGE = 10.0
"""Depth is measured up to here [m]: across the whole home, as in the paper's renderings."""
STILL = 1e-3
"""Objects that move farther than this [m] while recording would make the truth untrue."""


@dataclass(frozen=True)
class RecordSequences:
    """Record the nine synthetic sequences."""

    out: Path
    """Folder for the sequences, each in a folder of its name."""
    only: tuple[str, ...] = ()
    """Names of the sequences to record; all if empty."""
    seed: int = 0
    """Seeds furniture and noise; the tours are made for 0."""
    width: int = 320
    """Image width [px]; the height is three quarters of it."""

    def __post_init__(self) -> None:
        unknown = sorted(set(self.only) - set(TOURS))
        if unknown:
            raise SystemExit(f"no sequence named {', '.join(unknown)}; choose from {', '.join(TOURS)}")


def main(options: RecordSequences) -> dict[str, int]:
    """Record what is missing; returns the number of frames of each sequence."""
    torch.set_num_threads(1)
    names = options.only or tuple(TOURS)
    for name in tqdm(names, desc="recording", unit=" sequence", disable=None):
        if not (options.out / name).exists():
            record(options, name)
    return {name: len(RecordedSequence(options.out / name)) for name in names}


def record(options: RecordSequences, name: str) -> None:
    """Record one sequence in a folder beside its own, which takes its name only when it is whole."""
    part = options.out / f".{name}.part"
    shutil.rmtree(part, ignore_errors=True)
    tour = TOURS[name]
    episode = Episode(EpisodeOptions(part, tour.scene, options.seed), tour.start)
    try:
        film(options, tour, episode, part)
    finally:
        episode.close()
    part.rename(options.out / name)


def film(options: RecordSequences, tour: HomeTour, episode: Episode, folder: Path) -> None:
    """Drive a tour and write noisy frames, noise-free frames and the truth.

    Raises:
        SystemExit: if the robot touched something or an object moved: the truth would not hold.
    """
    world = episode.world
    intrinsics = PinholeCamera.from_fov(options.width, options.width * 3 // 4)
    camera = DepthCamera(
        world, intrinsics, link=episode.model.camera_link, max_range=MAX_RANGE, see_robot=False
    )
    noise, rng = DepthNoise(DepthNoiseConfig(max_range=MAX_RANGE)), np.random.default_rng(options.seed)

    def shoot() -> None:
        frame = camera.render()
        noisy.write(noise(frame.depth, rng), frame.T_world_camera)
        exact.write(frame.depth, frame.T_world_camera)

    drive = CameraTour(episode, shoot, shots_per_command=3)
    noisy, exact = (SequenceWriter(f, intrinsics, drive.fps) for f in (folder, folder / "noise_free"))
    drive.settle(tour.legs[0])
    settled = world.field().primitives
    for leg in tqdm(tour.legs, desc=folder.name, unit=" leg", leave=False, disable=None):
        drive.drive(leg)
    moved = {a.name for a in settled if np.abs(world.object_pose(a.name) - a.pose)[:3, 3].max() > STILL}
    if moved or episode.contacts():
        raise SystemExit(f"{folder}: the scene was disturbed: moved {moved}, touched {episode.contacts()}")
    width, depth, height = episode.scene.size or (0.0, 0.0, 0.0)
    room = np.array([[-width / 2, -depth / 2, 0.0], [width / 2, depth / 2, height]])
    save_truth(folder / "truth.json", settled, room)


if __name__ == "__main__":
    for name, frames in main(tyro.cli(RecordSequences)).items():
        print(f"{name}: {frames} frames")
