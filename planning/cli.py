"""`python -m planning solve`: plan a file of problems and write what was found."""

from __future__ import annotations

import importlib
import json
import logging
import os
import sys
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
import tyro
from tqdm import tqdm

from planning.errors import PlanningError, ProblemError
from planning.problems import Problem, load_problems
from planning.protocols import SphereRobot
from planning.solve import SolveConfig, Solver

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Solve:
    """Plan every problem of a file and write a list of results as JSON."""

    problems: Annotated[Path, tyro.conf.Positional]
    """JSON file, gzipped or not: a list `problems` of objects with set, index, joints, start, goal and obstacles
    (boxes, cylinders, spheres), as planning/problems.py tells."""
    robot: str = "panda"
    """Name of the robot."""
    out: Path = Path("results.json")
    """Where the results go: a list of objects with set, index, status, message, seconds, waypoints, times and
    clearance. After Ctrl-C it holds those found so far."""
    limit: int | None = None
    """How many problems of each set are solved, the first ones; all by default."""
    deadline: float | None = None
    """Wall time [s] for each problem; where it ends, the best path so far is the result."""
    loader: str = "robots:load"
    """What makes a robot of a name, as module:function."""
    json: bool = False
    """Print the outcome as one line of JSON instead of a table."""
    config: SolveConfig = field(default_factory=SolveConfig)
    """How problems are solved."""

    def run(self) -> str:
        """Solve and write; returns what to print.

        Raises:
            PlanningError: the problems or the robot cannot be used.
            OSError: the results cannot be written.
        """
        problems = _limited(load_problems(self.problems), self.limit)
        solver = Solver(load_robot(self.loader, self.robot), self.config)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        if problems:
            solver.solve(
                problems[0], self.deadline
            )  # compiles what is not in numba's cache, outside of the clock
        results: list[dict[str, Any]] = []
        try:
            for problem in tqdm(problems, desc="planning", unit="problem", disable=None):
                result = solver.solve(problem, self.deadline)
                results.append(result)
                logger.info(
                    "%s %d: %s in %.3f s", problem.set, problem.index, result["status"], result["seconds"]
                )
        finally:
            self.out.write_text(json.dumps(results))
        return json.dumps(summary(results) | {"file": str(self.out)}) if self.json else table(results)


def load_robot(loader: str, name: str) -> SphereRobot:
    """Call module:function with the name of a robot.

    Planning knows no robots of its own; who does is a matter of configuration. Raises `ProblemError` where the loader
    cannot be found or gives no robot.
    """
    module, _, function = loader.partition(":")
    try:
        robot = getattr(importlib.import_module(module), function)(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ProblemError(f"{loader}({name!r}) gives no robot: {error}") from error
    if not isinstance(robot, SphereRobot):
        raise ProblemError(f"{loader}({name!r}) gave a {type(robot).__name__}, which is no SphereRobot.")
    return robot


def table(results: list[dict[str, Any]]) -> str:
    """How many of each set were solved, and in what time."""
    sets = defaultdict(list)
    for result in results:
        sets[result["set"]].append(result)
    lines = [f"{'set':20s} {'solved':>9s} {'median':>8s} {'p95':>8s}  joint path"]
    for name, members in [*sorted(sets.items()), ("all", results)]:
        solved = [m for m in members if m["status"] == "success"]
        seconds = np.array([m["seconds"] for m in members] or [np.nan])
        lengths = [
            float(np.linalg.norm(np.diff(np.array(m["waypoints"]), axis=0), axis=1).sum()) for m in solved
        ]
        median, p95 = np.quantile(seconds, [0.5, 0.95])
        path = np.median(lengths) if lengths else np.nan
        lines.append(f"{name:20s} {len(solved):4d}/{len(members):<4d} {median:7.3f}s {p95:7.3f}s  {path:.2f}")
    return "\n".join(lines)


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts, and median and 95th percentile of the times [s]; None where there are no problems."""
    seconds = [r["seconds"] for r in results]
    median, p95 = np.quantile(seconds, [0.5, 0.95]).tolist() if results else (None, None)
    solved = sum(r["status"] == "success" for r in results)
    return {"problems": len(results), "solved": solved, "median_seconds": median, "p95_seconds": p95}


def _limited(problems: list[Problem], limit: int | None) -> list[Problem]:
    counts: dict[str, int] = defaultdict(int)
    kept = []
    for problem in problems:
        counts[problem.set] += 1
        if limit is None or counts[problem.set] <= limit:
            kept.append(problem)
    return kept


# tyro joins lines that are not indented.
DESCRIPTION = """Trajectories for robots made of spheres.
  python -m planning solve PROBLEMS.json.gz --robot panda --out results.json
  python -m planning solve --help                           its options
  --json: outcome or error as one line of JSON on stdout or stderr
  exit codes:
    0     all problems were tried; the results say which are solved
    1     a file could not be written, or a bug
    2     bad input, an unknown command or an unknown option
    130   stopped by Ctrl-C; the results so far are written"""


def main() -> None:
    """Entry point; what goes wrong is said in one line, see `DESCRIPTION` for exit codes."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    words = sys.argv[1:]
    try:
        if words and not words[0].startswith("-") and words[0] != "solve":
            raise PlanningError(f"there is no command {words[0]!r}; the only one is solve")
        command = tyro.extras.subcommand_cli_from_dict(
            {"solve": Solve}, prog="planning", description=DESCRIPTION
        )
        print(command.run(), flush=True)
    except PlanningError as error:
        _fail(2, error)
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        _fail(1, error)
    except KeyboardInterrupt:
        _fail(130, InterruptedError("stopped by Ctrl-C"))


def _fail(code: int, error: Exception) -> NoReturn:
    as_json = "--json" in sys.argv
    line = json.dumps({"error": type(error).__name__, "message": str(error)})
    print(line if as_json else f"planning: {error}", file=sys.stderr)
    sys.exit(code)
