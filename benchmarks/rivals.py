"""The neural field against voxel maps on one recorded sequence of a scene whose exact distances are known.

    python -m examples.record --out runs/recorded --scene office --seed 5
    python -m benchmarks.rivals runs/recorded --scene office --seed 5

All run live: frames that arrive while a method is busy are dropped, and a voxel map that is done waits for the next.
The points are like those of the paper's evaluation: random pixels of every 5th frame, and on each pixel's ray a z-depth
uniform in [0.1, D] m. The table has the mean SDF error, the same within 10 cm of a surface, the share of points whose
distance is more than 5 cm too large, the mean cosine distance of the gradient, CPU seconds per second of sequence,
CPU time of a query, frames used, and the memory of the field that answers, of what mapping goes on from, and of the
saved file.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor

from isdf import Mapper, MapperConfig
from isdf.datasets import DepthSequence, open_sequence
from isdf.errors import DatasetError, FrameError
from isdf.methods import Config, OnlineMapper, new_mapper
from isdf.runner import RunReport, run_at_rate
from isdf.voxel import ExactConfig, FiestaConfig, KinectFusionConfig, VoxbloxConfig, VoxelMapper
from robots.simulation import SceneField, make_scene

# Pixels measured farther than this [m] are no evaluation points: no method maps them.
REACH = 12.0
NEAREST = 0.1
METHODS: dict[str, Config] = {
    "isdf": MapperConfig(),
    "exact": ExactConfig(),
    "voxblox": VoxbloxConfig(),
    "voxblox 7.8 cm": VoxbloxConfig(voxel=0.078),
    "fiesta": FiestaConfig(),
    "kinectfusion": KinectFusionConfig(),
    "kinectfusion 4 cm": KinectFusionConfig(voxel=0.04),
}


@dataclass(frozen=True)
class Rivals:
    """Compare the mapping methods on a sequence recorded in a scene of primitives."""

    sequence: tyro.conf.Positional[Path]
    """Recorded sequence."""
    scene: Literal["apartment", "office", "flat"] = "office"
    """The scene it was recorded in."""
    seed: int = 0
    """And the scene's seed."""
    cpu_per_second: float = 1.0
    """CPU seconds allowed for each second of sequence; 0 is unlimited, with the default steps on every frame."""
    points: int = 20_000
    """Evaluation points."""


def main(options: Rivals) -> None:
    """Map with every method, then print one line for each."""
    torch.set_num_threads(1)
    sequence = open_sequence(options.sequence)
    truth = SceneField(make_scene(options.scene, options.seed))
    points = visible_points(sequence, options.points)
    distance, normal = truth.distance_and_gradient(points)
    print(f"{len(points)} points; errors in cm, memory in MB, CPU in seconds a second, queries in us a point")
    print(
        f"{'method':>18} {'error':>6} {'near':>6} {'>5 cm':>6} {'1-cos':>6} {'CPU':>5} {'query':>6} {'frames':>7} "
        f"{'field':>6} {'state':>6} {'file':>6}"
    )
    for name, config in METHODS.items():
        mapper, report = run(sequence, config, options.cpu_per_second)
        scores, query = evaluate(mapper.field(), points, distance, normal)
        field, state, file = memory(mapper)
        print(
            f"{name:>18} {scores[0]:6.2f} {scores[1]:6.2f} {scores[2]:5.1%} {scores[3]:6.3f} "
            f"{report.cpu_seconds / report.sequence_seconds:5.2f} {query:6.2f} {report.frames_used:7d} "
            f"{field:6.1f} {state:6.1f} {file:6.1f}",
            flush=True,
        )


def run(sequence: DepthSequence, config: Config, rate: float) -> tuple[OnlineMapper, RunReport]:
    """Map a sequence live, or without a limit of time when the rate is 0."""
    if rate > 0:
        return run_at_rate(sequence, config, rate, lambda *_: None)
    mapper, report, before = new_mapper(config), RunReport(), time.process_time()
    for index in range(len(sequence)):
        mapper.integrate(sequence[index])
    if isinstance(mapper, VoxelMapper):
        mapper.refresh()
    report.cpu_seconds = time.process_time() - before
    report.frames_used, report.sequence_seconds = mapper.frames_seen, len(sequence) / sequence.fps
    return mapper, report


def visible_points(sequence: DepthSequence, count: int) -> Tensor:
    """World points [m] in front of measured surfaces, spread over every 5th frame."""
    generator = torch.Generator().manual_seed(1)
    chosen_frames = range(0, len(sequence), 5)
    points = []
    for index in chosen_frames:
        try:
            frame = sequence[index]
        except (FrameError, DatasetError):
            continue
        surface = frame.thinned(1, REACH)
        surface = surface[torch.randint(len(surface), (count // len(chosen_frames),), generator=generator)]
        eye = frame.T_world_camera[:3, 3].float()
        z = (surface - eye) @ frame.T_world_camera[:3, 2].float()
        surface, z = surface[z > NEAREST], z[z > NEAREST]
        depth = NEAREST + torch.rand(len(z), generator=generator) * (z - NEAREST)
        points.append(eye + (surface - eye) * (depth / z)[:, None])
    return torch.cat(points)


def evaluate(field: Any, points: Tensor, distance: Tensor, normal: Tensor) -> tuple[list[float], float]:
    """Mean error [cm], the same near surfaces, share over-estimated, 1 - cosine; and the time of a query [us]."""
    before = time.process_time()
    predicted, gradient = field.distance_and_gradient(points)
    query = 1e6 * (time.process_time() - before) / len(points)
    error = predicted - distance
    near = distance.abs() < 0.1
    cosine = torch.cosine_similarity(gradient, normal, dim=-1)
    scores = (
        100 * error.abs().mean(),
        100 * error[near].abs().mean(),
        (error > 0.05).float().mean(),
        (1 - cosine).mean(),
    )
    return [float(score) for score in scores], query


def memory(mapper: OnlineMapper) -> tuple[float, float, float]:
    """Of the field that answers, of all that mapping goes on from, and of the saved file [MB]."""
    if isinstance(mapper, Mapper):
        field = sum(p.nbytes for p in mapper.network.parameters())
        # Two moments of the optimiser, the frozen copy, and the replayed images.
        state = 4 * field + sum(frame.depth.nbytes for frame in mapper.keyframes.frames)
    else:
        field = mapper.field().nbytes
        state = mapper.nbytes - field
    with tempfile.TemporaryDirectory() as folder:
        mapper.save(Path(folder) / "map.safetensors")
        file = (Path(folder) / "map.safetensors").stat().st_size
    return field / 1e6, state / 1e6, file / 1e6


if __name__ == "__main__":
    main(tyro.cli(Rivals))
