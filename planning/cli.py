"""`python -m planning solve`: plan a file of problems and write what was found."""

from __future__ import annotations

import importlib
import json
import logging
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from planning.errors import ProblemError
from planning.problems import Problem, load_problems
from planning.protocols import SphereRobot
from planning.solve import SolveConfig, Solver

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Solve:
    """Plan every problem of a file and write a list of results as JSON.

    Args:
        problems: JSON file, gzipped or not (see planning/problems.py).
        robot: name of the robot.
        out: where the results go: a list of objects with set, index, status, message, seconds, waypoints, times and
            clearance.
        limit: how many problems of each set are solved, the first ones; all by default.
        deadline: wall time [s] for each problem; where it ends, the best path so far is the result.
        loader: what makes a robot of a name, as module:function.
        config: how problems are solved.
    """

    problems: Annotated[Path, tyro.conf.Positional]
    robot: str = "panda"
    out: Path = Path("results.json")
    limit: int | None = None
    deadline: float | None = None
    loader: str = "robots:load"
    config: SolveConfig = field(default_factory=SolveConfig)

    def run(self) -> None:
        """Solve, write, and print a table."""
        problems = _limited(load_problems(self.problems), self.limit)
        solver = Solver(load_robot(self.loader, self.robot), self.config)
        if problems:
            solver.solve(
                problems[0], self.deadline
            )  # compiles what is not in numba's cache, outside of the clock
        results = []
        for problem in problems:
            result = solver.solve(problem, self.deadline)
            results.append(result)
            logger.info(
                "%s %d: %s in %.3f s", problem.set, problem.index, result["status"], result["seconds"]
            )
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.out.write_text(json.dumps(results))
        print(table(results))


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
        lines.append(
            f"{name:20s} {len(solved):4d}/{len(members):<4d} {np.median(seconds):7.3f}s "
            f"{np.quantile(seconds, 0.95):7.3f}s"
            f"  {np.median(lengths) if lengths else np.nan:.2f}"
        )
    return "\n".join(lines)


def _limited(problems: list[Problem], limit: int | None) -> list[Problem]:
    counts: dict[str, int] = defaultdict(int)
    kept = []
    for problem in problems:
        counts[problem.set] += 1
        if limit is None or counts[problem.set] <= limit:
            kept.append(problem)
    return kept


def main() -> None:
    """Entry point."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    command = tyro.extras.subcommand_cli_from_dict({"solve": Solve}, prog="planning")
    command.run()
