"""The paper's mapping experiments, one command each; interrupted runs go on where they stopped.

    python -m examples.record_sequences --out runs/sequences
    python -m benchmarks.mapping main --jobs 2
    python -m benchmarks.mapping bounds half --seeds 0 1 2
    python -m benchmarks.mapping fidelity --only apt_1_obj
    python -m benchmarks.mapping real --data $ISDF_DATA_DIR
    python -m benchmarks.mapping main --backend dask --cluster tcp://host:8786

Every run leaves a JSON file in OUT/EXPERIMENT; `python -m benchmarks.mapping_report OUT` makes tables and figures.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from joblib import Parallel, delayed
from tqdm import tqdm

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.experiments import EXPERIMENTS, REAL, REGION_OF, Experiment, Job
from benchmarks.runs import REAL_FPS, Study, prepare, run, write_json
from benchmarks.sequences import chosen
from benchmarks.workers import Workers, at_work

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Options(Workers):
    """Run mapping experiments on recorded sequences with known truth."""

    experiments: tyro.conf.Positional[tuple[Experiment, ...]]
    """main: all methods with one CPU second a second. half: half of that. bounds: ray, normal and batch bound with
    the small network. fidelity: the released settings at 30 steps a second, batch bound (about two CPU seconds a
    step). fidelity-bounds: the same with the other two bounds. real: real sequences, judged by held-out frames."""
    sequences: Path = Path("runs/sequences")
    """Folder that `python -m examples.record_sequences` wrote."""
    data: Path | None = None
    """Folder of the real sequences; by default what ISDF_DATA_DIR says."""
    out: Path = Path("runs/mapping")
    """Folder for the results."""
    only: tuple[str, ...] = ()
    """Names of the sequences to take; by default all in the folder."""
    methods: tuple[str, ...] = ()
    """Labels of the methods to run ("isdf", "exact", "isdf ray"); by default all of the experiment."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the methods that draw."""
    noise_free: bool = False
    """Map the noise-free depth; results go to EXPERIMENT_noise_free."""
    points: int = 200_000
    """Evaluation points at each time."""
    period: float = 5.0
    """Sequence time between evaluations [s]."""


def main(options: Options) -> list[str]:
    """Run what is not there yet; returns what failed."""
    if not options.experiments:
        raise SystemExit(f"name one experiment or more: {', '.join(EXPERIMENTS)}")
    data = options.data or (Path(os.environ["ISDF_DATA_DIR"]) if "ISDF_DATA_DIR" in os.environ else None)
    study = Study(
        options.sequences.resolve(),
        options.out.resolve(),
        options.points,
        options.period,
        data.resolve() if data else None,
    )
    _check_same_study(study)
    jobs = [job for name in options.experiments for job in _jobs(study, options, name)]
    with at_work(options):
        known = sorted({job.sequence for job in jobs if job.experiment != REAL})
        failed = _in_parallel("evaluation points", options, prepare, [(study, name) for name in known])
        # Its mapped region must be known before the others are judged in it.
        for title, first in (("Voxblox", True), ("methods", False)):
            share = [j for j in jobs if (j.method == REGION_OF) == first and not study.done(j)]
            failed += _in_parallel(title, options, run, [(study, job) for job in share])
    return failed


def _jobs(study: Study, options: Options, name: Experiment) -> list[Job]:
    """The jobs of one experiment that the options ask for."""
    if name != REAL:
        names = chosen(study.sequences, options.only)
    elif study.data is None:
        raise SystemExit("the real sequences are not here: give --data or set ISDF_DATA_DIR")
    else:
        names = chosen(
            study.data, options.only, REAL_FPS, "poses.txt", "give --data the folder that has them"
        )
    jobs = EXPERIMENTS[name](names, options.seeds)
    labels = sorted({job.method for job in jobs})
    jobs = [job for job in jobs if not options.methods or job.method in options.methods]
    if not jobs:
        raise SystemExit(f"{name} has the methods {', '.join(labels)}, not {', '.join(options.methods)}")
    if options.noise_free and name != REAL:
        jobs = [replace(job, noise_free=True, experiment=f"{job.experiment}_noise_free") for job in jobs]
    return jobs


def _check_same_study(study: Study) -> None:
    """Refuse to mix results of different points or sequences in one folder."""
    file = study.out / "study.json"
    now = {"sequences": str(study.sequences), "points": study.points, "period": study.period}
    if file.exists() and (found := json.loads(file.read_text())) != now:
        raise SystemExit(f"{study.out} has results of {found}, not of {now}; choose another --out")
    if not file.exists():
        write_json(file, now)


def _in_parallel(
    title: str, options: Options, work: Callable[..., Any], tasks: list[tuple[Study, Any]]
) -> list[str]:
    """Do all tasks with a progress bar; returns what failed, since one bad map must not stop a night's work."""
    # Ray's backend cannot hand out results one by one.
    mode = "list" if options.backend == "ray" else "generator_unordered"
    calls = (delayed(_attempt)(work, *task) for task in tasks)
    done = Parallel(n_jobs=options.jobs, return_as=mode)(calls) if tasks else []
    with tqdm(done, total=len(tasks), desc=title, unit="run", disable=None) as bar:
        return [message for message in bar if message]


def _attempt(work: Callable[..., Any], study: Study, task: Any) -> str | None:
    try:
        work(study, task)
    except Exception as error:
        logger.debug("failed", exc_info=True)
        return f"{getattr(task, 'key', task)}: {type(error).__name__}: {error}"
    return None


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING)
    failures = main(tyro.cli(Options))
    print("\n".join(failures) or "all results are in place")
    sys.exit(1 if failures else 0)
