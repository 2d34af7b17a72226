"""One job of an experiment from the sequence to its result file: map, judge as time goes on, write."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.experiments import REAL, REGION_OF, Job
from benchmarks.stages import stage_times
from isdf import IsdfConfig, IsdfMapper, MapperConfig, NotReadyError
from isdf.datasets import DepthSequence, open_sequence
from isdf.evaluation import (
    Truth,
    VisibleRegion,
    draw_rays,
    evaluate,
    evaluate_rays,
    hold_out,
    unseen_points,
)
from isdf.methods import OnlineMapper, new_mapper
from isdf.runner import RunReport, Watch
from robots.simulation import load_truth

# Real sequences by their folder in the data directory, and their frames a second, which the folders do not say.
REAL_FPS = {"seq_7scenes": 10.0, "seq_tum_fr3_cabinet58": 1.43}
# Steps whose stages are timed after a run.
TIMED_STEPS = 10


@dataclass(frozen=True)
class Study:
    """Where sequences are read and results written, and how often and how densely maps are judged.

    Args:
        sequences: folder of recorded sequences with `truth.json` and `noise_free/` in each.
        out: folder of the results.
        points: evaluation points at each time; the paper's 200,000. A quarter of them in unseen space, a tenth as
            many rays of held-out frames.
        period: sequence time between two evaluations [s].
        data: folder of the real sequences.
    """

    sequences: Path
    out: Path
    points: int = 200_000
    period: float = 5.0
    data: Path | None = None

    def result(self, job: Job) -> Path:
        """The result file of a job."""
        return self.out / f"{job.key}.json"

    def map_file(self, job: Job) -> Path:
        """Where a job leaves its map."""
        return self.out / "maps" / f"{job.key}.safetensors"

    def points_file(self, sequence: str, name: str) -> Path:
        """Evaluation points of a sequence: a time's number, or "unseen"."""
        return self.out / "points" / sequence / f"{name}.npz"

    def done(self, job: Job) -> bool:
        """Whether there is a result of this very job: the same configuration and clock."""
        path = self.result(job)
        if not path.exists():
            return False
        found = json.loads(path.read_text())
        return all(found[name] == value for name, value in _identity(job).items())


def prepare(study: Study, name: str) -> None:
    """Draw the evaluation points of a sequence and look up the truth at them, once for all methods."""
    if study.points_file(name, "unseen").exists():
        return
    sequence = open_sequence(study.sequences / name / "noise_free")
    truth = load_truth(study.sequences / name / "truth.json")
    region = VisibleRegion(sequence)
    for index, moment in enumerate(evaluation_times(sequence, study.period)):
        points = region.points(round(moment * sequence.fps) - 1, study.points, seed=index)
        save_truth(study.points_file(name, f"{index:02d}"), Truth.of(truth.field, points))
    room = torch.as_tensor(truth.room, dtype=torch.float32)
    unseen = unseen_points(sequence, truth.field, room, study.points // 4, seed=0)
    save_truth(study.points_file(name, "unseen"), Truth.of(truth.field, unseen))


def evaluation_times(sequence: DepthSequence, period: float) -> list[float]:
    """Every `period` seconds, and the end."""
    end = len(sequence) / sequence.fps
    return [*np.arange(period, end - 0.3 * period, period).tolist(), end]


def run(study: Study, job: Job) -> Path:
    """Do a job and leave its result file; one that is there already is kept."""
    if not study.done(job):
        torch.set_num_threads(1)
        values = (_on_real if job.experiment == REAL else _on_known)(study, job)
        write_json(study.result(job), values)
    return study.result(job)


def _on_known(study: Study, job: Job) -> dict[str, Any]:
    """Map a sequence of known truth, and judge the map at every evaluation time."""
    folder = study.sequences / job.sequence
    sequence = open_sequence(folder / "noise_free" if job.noise_free else folder)
    watch = Snapshots(evaluation_times(sequence, study.period)[:-1], sequence.fps)
    mapper, report = _map(job, sequence, watch)
    shots = [*watch.taken, (report.sequence_seconds, mapper.steps, mapper.field())]
    unseen = read_truth(study.points_file(job.sequence, "unseen"))
    return _record(study, job, mapper, report) | {
        "over_time": [_judge(study, job, index, *shot) for index, shot in enumerate(shots)],
        "unseen": evaluate(mapper.field(), unseen).as_json(),
    }


def _on_real(study: Study, job: Job) -> dict[str, Any]:
    """Map nine tenths of a real sequence, and predict the depth of the other frames."""
    assert study.data is not None
    mapped, held = hold_out(open_sequence(study.data / job.sequence, REAL_FPS.get(job.sequence)))
    mapper, report = _map(job, mapped, lambda *_: None)
    rays = draw_rays(held, study.points // 10, seed=0)
    scores = evaluate_rays(mapper.field(), rays)
    return _record(study, job, mapper, report) | {"held_out": scores.as_json()}


@dataclass
class Snapshots:
    """Watches a run and keeps the map's field at chosen times."""

    times: Sequence[float]
    fps: float
    taken: list[tuple[float, int, Any]] = field(default_factory=list)

    def __call__(self, mapper: OnlineMapper, arrived: int) -> None:
        """Take every snapshot that is due: time [s], steps, and the field or None while there is none."""
        while len(self.taken) < len(self.times) and arrived >= self.times[len(self.taken)] * self.fps:
            try:
                shown = mapper.field()
            except NotReadyError:
                shown = None
            self.taken.append((self.times[len(self.taken)], mapper.steps, shown))


def _map(job: Job, sequence: DepthSequence, watch: Watch) -> tuple[OnlineMapper, RunReport]:
    if not isinstance(job.config, IsdfConfig):
        # What is compiled is compiled before the clock runs.
        trial = new_mapper(job.config)
        for index in range(min(2, len(sequence))):
            trial.integrate(sequence[index])
    return job.clock.run(sequence, job.config, watch)


def _judge(study: Study, job: Job, index: int, moment: float, steps: int, shown: Any) -> dict[str, Any]:
    """Scores of one snapshot in the region visible then, and in the part of it that Voxblox had mapped."""
    empty = {"time": moment, "steps": steps, "visible": None, "own_gradient": None, "voxblox_region": None}
    if shown is None:
        return empty
    truth = read_truth(study.points_file(job.sequence, f"{index:02d}"))
    unmapped = (
        None if isinstance(job.config, (IsdfConfig, MapperConfig)) else shown.confidence(truth.points) == 0
    )
    region = _region(study, job, index, truth, unmapped)
    own = evaluate(shown, truth, "own").gradient_distance
    found: dict[str, Any] = {
        "visible": evaluate(shown, truth, unmapped=unmapped).as_json(),
        "own_gradient": own,
    }
    if region is not None:
        inside = None if unmapped is None else unmapped[region]
        found["voxblox_region"] = evaluate(shown, truth.where(region), unmapped=inside).as_json()
    if unmapped is not None:
        found["unmapped"] = float(unmapped.float().mean())
    return empty | found


def _region(study: Study, job: Job, index: int, truth: Truth, unmapped: Any) -> torch.Tensor | None:
    """Which of a time's points Voxblox had mapped by then, in this experiment or else in the main one."""
    folder = study.out / "regions"
    name = f"{job.sequence}/{index:02d}.npy"
    if job.method == REGION_OF:
        _replace(folder / job.experiment / name, lambda part: np.save(part, np.packbits(~unmapped.numpy())))
        return ~unmapped
    file = next((p for e in (job.experiment, "main") if (p := folder / e / name).exists()), None)
    if file is None:
        return None
    return torch.from_numpy(np.unpackbits(np.load(file), count=len(truth)).astype(bool))


def _record(study: Study, job: Job, mapper: OnlineMapper, report: RunReport) -> dict[str, Any]:
    """What every result holds; leaves the map's file, too."""
    file = study.map_file(job)
    file.parent.mkdir(parents=True, exist_ok=True)
    mapper.save(file)
    bounds = mapper.bounds
    points = bounds[0] + torch.rand(50_000, 3, generator=torch.Generator().manual_seed(0)) * (
        bounds[1] - bounds[0]
    )
    return _identity(job) | {
        "report": dataclasses.asdict(report),
        "cpu_per_second": report.cpu_seconds / report.sequence_seconds,
        "memory": _memory(mapper) | {"file": file.stat().st_size},
        "query_us": query_time(mapper.field(), points),
        "keyframes": _keyframes(mapper),
        "stages_ms": stage_times(mapper, TIMED_STEPS) if isinstance(mapper, IsdfMapper) else None,
        "machine": {
            "processor": processor(),
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
    }


def _identity(job: Job) -> dict[str, Any]:
    """A job in plain values, as they come back from a file."""
    return json.loads(json.dumps(dataclasses.asdict(job)))


def _keyframes(mapper: OnlineMapper) -> list[list[float]]:
    """Camera positions of the keyframes [m], which only the paper's method has."""
    frames = mapper.keyframes.frames if isinstance(mapper, IsdfMapper) else []
    return [frame.T_world_camera[:3, 3].tolist() for frame in frames]


def _memory(mapper: OnlineMapper) -> dict[str, int]:
    """Bytes of the field that answers queries, and of all that mapping goes on from."""
    if not isinstance(mapper, IsdfMapper):
        return {"field": mapper.field().nbytes, "state": mapper.nbytes}
    weights = sum(p.nbytes for p in mapper.network.parameters())
    # Two moments of the optimiser, the frozen copy, and the replayed images.
    return {"field": weights, "state": 4 * weights + sum(f.depth.nbytes for f in mapper.keyframes.frames)}


def query_time(shown: Any, points: torch.Tensor) -> float:
    """CPU time of distance and gradient at a point [us]."""
    shown.distance_and_gradient(points[:10])  # what is made or compiled once is no query's
    before = time.process_time()
    shown.distance_and_gradient(points)
    return 1e6 * (time.process_time() - before) / len(points)


def processor() -> str:
    """Model name of the CPU, where the system says it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def write_json(path: Path, values: Any) -> None:
    """Write a file in one rename, so that an interrupted run leaves none or a whole one."""
    _replace(path, lambda part: part.write_text(json.dumps(values, indent=1) + "\n"))


def save_truth(path: Path, truth: Truth) -> None:
    """Write evaluation points, in one rename."""
    arrays = {f.name: getattr(truth, f.name).numpy() for f in dataclasses.fields(truth)}
    _replace(path, lambda part: np.savez(part, **arrays))


def read_truth(path: Path) -> Truth:
    """Read evaluation points."""
    with np.load(path, allow_pickle=False) as arrays:
        return Truth(*(torch.from_numpy(arrays[f.name]) for f in dataclasses.fields(Truth)))


def _replace(path: Path, write: Callable[[Path], Any]) -> None:
    """Let `write` fill a file beside it, which then takes its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, part = tempfile.mkstemp(dir=path.parent, prefix=".part-", suffix=path.suffix)
    os.close(handle)
    try:
        write(Path(part))
        os.replace(part, path)
    finally:
        Path(part).unlink(missing_ok=True)
