"""The default map beside its rivals, live with one CPU second a second, on sequences whose exact distances are known.

    python -m examples.record_sequences --out runs/sequences
    python -m benchmarks.realtime --sequences runs/sequences

One line a sequence and method: SDF error in the visible region at the end, mean over the sequence, below 0.3 m true
distance, in free space more than 25 cm from anything seen and that over the exact-distance map's; cosine distance of
the gradient, CHOMP cost error, share of visible points overestimated by more than 5 cm; area under the ROC curve of
the confidence for errors above 5 cm, among visible and unseen points together and among the visible; CPU seconds a
second of sequence, share of frames used, memory of the field that answers [MB], and millions of queries a second of
distance and gradient on one core.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

from isdf import IsdfConfig, MapperConfig
from isdf.datasets import open_sequence
from isdf.evaluation import Truth, VisibleRegion, evaluate, roc_area, unseen_points
from isdf.methods import Config, OnlineMapper
from isdf.runner import run_at_rate
from isdf.voxel import ExactConfig, KinectFusionConfig, VoxbloxConfig
from robots.simulation import load_truth

NEAR = 0.3
REFERENCE = "exact"
METHODS: dict[str, Config] = {
    "exact": ExactConfig(),
    "default": MapperConfig(),
    "kinectfusion": KinectFusionConfig(voxel=0.04),
    "voxblox": VoxbloxConfig(),
    "isdf": IsdfConfig(),
}
COLUMNS = "end mean near unseen ratio 1-cos cost over auc auc-vis CPU frames MB M/s"


@dataclass(frozen=True)
class Realtime:
    """Map and judge."""

    sequences: Path = Path("runs/sequences")
    """Folder of recorded sequences with truth.json and noise_free/."""
    only: tuple[str, ...] = ()
    """Names of the sequences to take; all if empty."""
    methods: tuple[Literal["exact", "default", "kinectfusion", "voxblox", "isdf"], ...] = ("exact", "default")
    """The exact-distance map comes first: the others are compared with it."""
    points: int = 50_000
    """Evaluation points at the end; a tenth of them at the other times."""
    period: float = 5.0
    """Sequence time between evaluations [s]."""
    cpu_per_second: float = 1.0
    """CPU seconds allowed for each second of sequence."""


def main(options: Realtime) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    names = options.only or tuple(sorted(p.parent.name for p in options.sequences.glob("*/truth.json")))
    print("errors in cm; 1-cos, cost, over and auc as numbers; see the module's text for the columns")
    print(f"{'sequence':>10} {'method':>12} " + " ".join(f"{c:>7}" for c in COLUMNS.split()))
    for name in names:
        reference = None
        for method in sorted(options.methods, key=lambda m: m != REFERENCE):
            row = judged(options, name, METHODS[method], reference)
            reference = row["unseen"] if method == REFERENCE else reference
            cells = " ".join(f"{row[c]:7.3f}" if row[c] is not None else f"{'-':>7}" for c in COLUMNS.split())
            print(f"{name:>10} {method:>12} {cells}", flush=True)


def judged(options: Realtime, name: str, config: Config, reference: float | None) -> dict[str, Any]:
    """Map one sequence with one method; returns the columns."""
    folder = options.sequences / name
    sequence, clean = open_sequence(folder), open_sequence(folder / "noise_free")
    truth = load_truth(folder / "truth.json")
    region, errors, due = VisibleRegion(clean), [], [options.period]

    def watch(mapper: OnlineMapper, arrived: int) -> None:
        if arrived / sequence.fps >= due[0] and mapper.steps:
            due[0] += options.period
            seen = Truth.of(truth.field, region.points(arrived - 1, options.points // 10, len(errors)))
            errors.append(float((mapper.field().distance(seen.points) - seen.distance).abs().mean()))

    mapper, report = run_at_rate(sequence, config, options.cpu_per_second, watch)
    field = mapper.field()
    visible = Truth.of(truth.field, region.points(len(sequence) - 1, options.points, seed=99))
    room = torch.as_tensor(truth.room, dtype=torch.float32)
    hidden = Truth.of(truth.field, unseen_points(clean, truth.field, room, options.points // 4, seed=0))
    scores = evaluate(field, visible)
    near = evaluate(field, visible.where(visible.distance < NEAR))
    unseen = 100 * (evaluate(field, hidden).sdf_error or float("nan"))
    before = time.process_time()
    predicted, _ = field.distance_and_gradient(visible.points)
    rate = len(visible) / (time.process_time() - before) / 1e6
    areas: list[float | None] = [None, None]
    if hasattr(field, "confidence"):
        points = torch.cat([visible.points, hidden.points])
        error = torch.cat([predicted - visible.distance, field.distance(hidden.points) - hidden.distance])
        areas = [
            roc_area(field.confidence(points), error),
            roc_area(field.confidence(visible.points), predicted - visible.distance),
        ]
    end = 100 * (scores.sdf_error or float("nan"))
    return {
        "end": end,
        "mean": float(np.mean([*(100 * e for e in errors), end])),
        "near": 100 * (near.sdf_error or float("nan")),
        "unseen": unseen,
        "ratio": unseen / reference if reference else None,
        "1-cos": scores.gradient_distance,
        "cost": scores.cost_error,
        "over": scores.overestimated,
        "auc": areas[0],
        "auc-vis": areas[1],
        "CPU": report.cpu_seconds / report.sequence_seconds,
        "frames": report.frames_used / report.frames,
        "MB": getattr(field, "nbytes", 0) / 1e6 or None,
        "M/s": rate,
    }


if __name__ == "__main__":
    main(tyro.cli(Realtime))
