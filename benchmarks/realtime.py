"""The default map beside its rivals, live with one CPU second a second, on sequences whose exact distances are known.

    python -m examples.record_sequences --out runs/sequences
    python -m benchmarks.realtime --sequences runs/sequences --out runs/realtime

"seen" is no map, but how well any could do that guesses nothing: exact distances to the surface in noise-free images.

One line a sequence and method: SDF error in the visible region at the end, mean over the sequence, below 0.3 m true
distance, in free space more than 25 cm from anything seen and that over the exact-distance map's; cosine distance of
the gradient, CHOMP cost error, share of visible points overestimated by more than 5 cm; area under the ROC curve of
the confidence for errors above 5 cm, among visible and unseen points together and among the visible; CPU seconds a
second of sequence, share of frames used, memory of the field that answers [MB], age of the oldest frame whose
information was not yet in the field [s] (95th percentile and greatest), millions of queries a second of distance and
gradient on two cores of the field and of the baked one, and what baking adds to the error [cm].

Then the default map's figures beside their targets, and its CPU time a frame by stage. All of it goes to
`realtime.json` in `--out`, and how true the confidence is to `reliability.png`; with `--publish` the table and that
picture also take their places in a Markdown page.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.publishing import publish
from benchmarks.realtime_report import Reliability, save_reliability, table, target_lines
from benchmarks.sequences import chosen
from benchmarks.stages import map_stages
from isdf import IsdfConfig, MapperConfig
from isdf.datasets import DepthSequence, open_sequence
from isdf.evaluation import SeenSurface, Truth, VisibleRegion, evaluate, roc_area, unseen_points
from isdf.methods import Config, OnlineMapper
from isdf.runner import Begun, RunReport, run_at_rate
from isdf.voxel import ExactConfig, KinectFusionConfig, VoxbloxConfig
from robots.simulation import load_truth

NEAR = 0.3
REFERENCE = "exact"
FLOOR = "seen"
METHODS: dict[str, Config] = {
    "exact": ExactConfig(),
    "default": MapperConfig(),
    "kinectfusion": KinectFusionConfig(voxel=0.04),
    "voxblox": VoxbloxConfig(),
    "isdf": IsdfConfig(),
}
COLUMNS = "end mean near unseen ratio 1-cos cost over auc auc-vis CPU frames MB age95 age M/s baked bake-cm"
# Spacing of the baked grid [m].
BAKED = 0.04


@dataclass(frozen=True)
class Realtime:
    """Map and judge."""

    sequences: Path = Path("runs/sequences")
    """Folder of recorded sequences with truth.json and noise_free/."""
    out: Path = Path("runs/realtime")
    """Folder for the figures."""
    only: tuple[str, ...] = ()
    """Names of the sequences to take; all if empty."""
    methods: tuple[Literal["seen", "exact", "default", "kinectfusion", "voxblox", "isdf"], ...] = (
        "seen",
        "exact",
        "default",
    )
    """The exact-distance map comes first: the others are compared with it."""
    points: int = 50_000
    """Evaluation points at the end; a tenth of them at the other times."""
    period: float = 5.0
    """Sequence time between evaluations [s]."""
    cpu_per_second: float = 1.0
    """CPU seconds allowed for each second of sequence."""
    publish: Path | None = None
    """A Markdown page with places for the table and the picture."""


@dataclass
class Ages:
    """How old what the camera has seen is when it gets into the field [s]."""

    rate: float
    report: RunReport = field(default_factory=RunReport)
    waiting: list[float] = field(default_factory=list)
    seen: list[float] = field(default_factory=list)
    steps: int = 0
    used: int = 0

    def note(self, mapper: OnlineMapper, taken_at: float) -> None:
        """After a frame that was taken at this time of the sequence [s]."""
        if self.report.frames_used > self.used:
            self.waiting.append(taken_at)
        if mapper.steps > self.steps:
            now = (self.report.cpu_seconds + self.report.waited_seconds) / self.rate
            self.seen += [now - t for t in self.waiting]
            self.waiting = []
        self.used, self.steps = self.report.frames_used, mapper.steps


class Judge:
    """One sequence and the points at which every method is judged."""

    def __init__(self, options: Realtime, name: str) -> None:
        folder = options.sequences / name
        self.options, self.name = options, name
        self.sequence: DepthSequence = open_sequence(folder)
        clean, self.truth = open_sequence(folder / "noise_free"), load_truth(folder / "truth.json")
        self.clean, self.region = clean, VisibleRegion(clean)
        self.visible = Truth.of(
            self.truth.field, self.region.points(len(self.sequence) - 1, options.points, seed=99)
        )
        room = torch.as_tensor(self.truth.room, dtype=torch.float32)
        hidden = unseen_points(clean, self.truth.field, room, options.points // 4, seed=0)
        self.hidden = Truth.of(self.truth.field, hidden)
        self.passing: dict[int, Truth] = {}

    def row(self, method: str, reference: float | None, reliability: Reliability) -> dict[str, Any]:
        """Map the sequence with one method; returns the columns."""
        options, sequence = self.options, self.sequence
        errors, due, ages = [], [options.period], Ages(options.cpu_per_second)

        def watch(mapper: OnlineMapper, arrived: int) -> None:
            ages.note(mapper, (arrived - 1) / sequence.fps)
            if arrived / sequence.fps >= due[0] and mapper.steps:
                due[0] += options.period
                seen = self._seen(arrived - 1, len(errors))
                errors.append(float((mapper.field().distance(seen.points) - seen.distance).abs().mean()))

        begun = Begun(ages.report)
        mapper, report = run_at_rate(sequence, METHODS[method], options.cpu_per_second, watch, begun)
        found = mapper.field()
        scores = self._scores(found)
        unseen = 100 * (evaluate(found, self.hidden).sdf_error or float("nan"))
        return scores | {
            "mean": float(np.mean([*(100 * e for e in errors), scores["end"]])),
            "unseen": unseen,
            "ratio": unseen / reference if reference else None,
            "CPU": report.cpu_seconds / report.sequence_seconds,
            "frames": report.frames_used / report.frames,
            "refused": len(report.frames_refused),
            "MB": getattr(found, "nbytes", 0) / 1e6 or None,
            "age95": float(np.percentile(ages.seen, 95)),
            "age": max(ages.seen),
            **self._confidence(found, reliability),
            **self._speed(found),
        }

    def floor(self) -> dict[str, Any]:
        """The columns of the visible region, of exact distances to all surface that was seen, without noise."""
        surface = SeenSurface(self.clean, self.truth.field)
        return dict.fromkeys(COLUMNS.split()) | self._scores(surface)

    def _scores(self, found: Any) -> dict[str, Any]:
        """Errors in the visible region at the end."""
        nan, close = float("nan"), self.visible.where(self.visible.distance < NEAR)
        scores, near = evaluate(found, self.visible), evaluate(found, close)
        return {
            "end": 100 * (scores.sdf_error or nan),
            "near": 100 * (near.sdf_error or nan),
            "1-cos": scores.gradient_distance,
            "cost": scores.cost_error,
            "over": scores.overestimated,
        }

    def _seen(self, last: int, seed: int) -> Truth:
        if last not in self.passing:
            points = self.region.points(last, self.options.points // 10, seed)
            self.passing[last] = Truth.of(self.truth.field, points)
        return self.passing[last]

    def _confidence(self, found: Any, reliability: Reliability) -> dict[str, float | None]:
        if not hasattr(found, "confidence"):
            return {"auc": None, "auc-vis": None}
        sure, wrong = [], []
        for truth in (self.visible, self.hidden):
            sure.append(found.confidence(truth.points))
            wrong.append(found.distance(truth.points) - truth.distance)
        reliability.add(*sure, *wrong)
        return {"auc": roc_area(torch.cat(sure), torch.cat(wrong)), "auc-vis": roc_area(sure[0], wrong[0])}

    def _speed(self, found: Any) -> dict[str, float | None]:
        """Queries a second on two cores, by the CPU time of one: the others may be busy. And what baking costs."""
        points = self.visible.points
        baked = found.bake(BAKED)
        added = (baked.distance(points) - found.distance(points)).abs().mean()
        return {"M/s": rate(found, points), "baked": rate(baked, points), "bake-cm": 100 * float(added)}


def rate(found: Any, points: Tensor) -> float:
    """Millions of distances and gradients that two cores make in a second: twice what one makes, the best of 3."""
    took = []
    for _ in range(3):
        before = time.process_time()
        found.distance_and_gradient(points)
        took.append(time.process_time() - before)
    return 2 * len(points) / min(took) / 1e6


def main(options: Realtime) -> None:
    """Print the tables and write them down."""
    torch.set_num_threads(1)
    names = chosen(options.sequences, options.only)
    options.out.mkdir(parents=True, exist_ok=True)
    print("errors in cm; 1-cos, cost, over and auc as numbers; see the module's text for the columns")
    print(f"{'sequence':>10} {'method':>12} " + " ".join(f"{c:>7}" for c in COLUMNS.split()))
    rows: dict[str, dict[str, Any]] = {}
    reliability = {method: Reliability() for method in options.methods}
    for name in names:
        judge, reference = Judge(options, name), None
        rows[name] = {}
        for method in sorted(options.methods, key=lambda m: m != REFERENCE):
            row = judge.floor() if method == FLOOR else judge.row(method, reference, reliability[method])
            rows[name][method] = row
            reference = row["unseen"] if method == REFERENCE else reference
            cells = " ".join(f"{row[c]:7.3f}" if row[c] is not None else f"{'-':>7}" for c in COLUMNS.split())
            print(f"{name:>10} {method:>12} {cells}", flush=True)
            (options.out / "realtime.json").write_text(json.dumps(rows, indent=1))
    if "default" in options.methods:
        targets = {name: methods["default"] for name, methods in rows.items()}
        print("\n".join(["", *target_lines(targets)]))
        save_reliability(options.out / "reliability.png", reliability["default"])
        stages = map_stages(judge.sequence)
        print("\nCPU time of a frame [ms]: " + ", ".join(f"{k} {v:.1f}" for k, v in stages.items()))
        (options.out / "stages.json").write_text(json.dumps(stages, indent=1))
    if options.publish:
        publish(options.publish, {"realtime": table(rows)}, [options.out / "reliability.png"])


if __name__ == "__main__":
    main(tyro.cli(Realtime))
