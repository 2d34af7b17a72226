"""Many episodes of any kind: in parallel, each with a report of its own, and a second run does what is missing."""

from __future__ import annotations

import json
import logging
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from joblib import Parallel, delayed
from tqdm import tqdm

from benchmarks.runs import write_json
from benchmarks.workers import Workers, at_work


class Task(Protocol):
    """One episode: everything it needs to run anywhere."""

    folder: str

    def run(self) -> dict[str, Any]:
        """Its report."""
        ...

    def told(self) -> dict[str, Any]:
        """What its report says of it."""
        ...


@dataclass(frozen=True, kw_only=True)
class EpisodesOptions(Workers):
    """What every kind takes."""

    out: Path = Path("runs/closed_loop")
    """Folder for the results; episodes that are there already are kept."""
    episodes: int = 50
    """How many."""
    seed: int = 0
    """Seeds what is drawn, and with the number of an episode all else."""

    def tasks(self) -> list[Any]:
        """One `Task` for each episode."""
        raise NotImplementedError

    def summary(self, reports: list[dict]) -> str:
        """What to print in the end."""
        raise NotImplementedError


def run_missing(options: EpisodesOptions) -> list[dict]:
    """Run the episodes that have no report yet, write summary.md; returns all reports.

    Refuses a folder whose reports are of other episodes, such as those of another seed.
    """
    tasks = options.tasks()
    missing = [task for task in tasks if not is_done(task)]
    with at_work(options):
        mode = "list" if options.backend == "ray" else "generator_unordered"
        done = Parallel(n_jobs=options.jobs, return_as=mode)(delayed(attempt)(task) for task in missing)
        list(tqdm(done, total=len(missing), desc="episodes", unit="episode", disable=None))
    reports = [json.loads((Path(task.folder) / "report.json").read_text()) for task in tasks]
    text = options.summary(reports)
    (options.out / "summary.md").write_text(text)
    print(text)
    return reports


def is_done(task: Task) -> bool:
    """Whether there is a report of this very episode; refuses one of another."""
    path = Path(task.folder) / "report.json"
    if not path.exists():
        return False
    found, told = json.loads(path.read_text())["task"], json.loads(json.dumps(task.told()))
    other = sorted(key for key in told if key != "folder" and found.get(key) != told[key])
    if other:
        raise SystemExit(
            f"{path} is of another episode: its {', '.join(other)} differ; choose another --out, or the options it had"
        )
    return True


def attempt(task: Task) -> None:
    """One episode; an error becomes its report."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        report = task.run()
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        report = {"success": False, "error": what, "traceback": traceback.format_exc()}
    finally:
        logging.disable(before)
    Path(task.folder).mkdir(parents=True, exist_ok=True)
    write_json(Path(task.folder) / "report.json", {"task": task.told(), **report})
