"""Planners on MotionBenchMaker's problems in one run: the same problems, the same checker, a picture.

    python -m benchmarks.planning --out runs/planning          # all planners that are installed; goes on where it ended

Every planner gets every problem in turn, so that all meet the same machine. What counts is the verdict of
`benchmarks.planning_check`, which shares no code with any of them; problems whose own start or goal fails it are listed
apart. Writes results.jsonl (a line a problem and planner), table.md and success.png.
"""

from __future__ import annotations

import gzip
import json
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
import tyro

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import robots
from benchmarks.planning_check import Checker
from benchmarks.planning_rivals import PLANNERS, Planner, checked_robot
from planning.problems import Problem, load_problems
from planning.solve import SolveConfig

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@dataclass(frozen=True)
class Planning:
    """Solve, check, tabulate, draw."""

    out: Path = Path("runs/planning")
    data: Path = field(default_factory=lambda: Path(os.environ.get("ISDF_DATA_DIR", "../shared/data")))
    """Folder with motionbenchmaker/ROBOT_problems.json.gz."""
    robots: tuple[Literal["panda", "fetch"], ...] = ("panda",)
    planners: tuple[Literal["ours", "ompl", "vamp", "tesseract"], ...] = ("ours", "ompl", "vamp", "tesseract")
    limit: int = 50
    """Problems of each set."""
    deadline: float = 10.0
    """[s] a problem."""

    def run(self) -> None:
        """Go on with what is missing, then report."""
        self.out.mkdir(parents=True, exist_ok=True)
        for robot in self.robots:
            self._solve(robot)
        results = [r for r in read(self.out / "results.jsonl") if r["robot"] in self.robots]
        text = "\n\n".join(table(robot, results) for robot in self.robots)
        (self.out / "table.md").write_text(text + "\n")
        picture(results, self.out / "success.png")
        print(text)

    def _solve(self, robot_name: str) -> None:
        path = self.data / "motionbenchmaker" / f"{robot_name}_problems.json.gz"
        raw = json.loads(gzip.decompress(path.read_bytes()))["problems"]
        problems = load_problems(path)
        robot, done = robots.load(robot_name), {key(r) for r in read(self.out / "results.jsonl")}
        checker, planners = Checker(checked_robot(robot_name, robot)), self._installed(robot_name, robot)
        warm = set()
        with (self.out / "results.jsonl").open("a") as lines:
            for problem, entry in zip(problems, raw, strict=True):
                if problem.index > self.limit:
                    continue
                for name, plan in planners.items():
                    if (robot_name, name, problem.set, problem.index) in done:
                        continue
                    if name not in warm:  # compiled and loaded outside of the clock
                        plan(problem, self.deadline)
                        warm.add(name)
                    line = measured(plan, problem, entry, checker, self.deadline)
                    line = {"robot": robot_name, "planner": name, **line}
                    lines.write(json.dumps(line) + "\n")
                    lines.flush()

    def _installed(self, robot_name: str, robot: robots.Robot) -> dict[str, Planner]:
        found = {}
        for name in self.planners:
            try:
                found[name] = PLANNERS[name](robot_name, robot)
            except ImportError as error:
                print(f"{name} is left out: {error}")
        return found


def measured(
    plan: Planner, problem: Problem, entry: dict[str, Any], checker: Checker, deadline: float
) -> dict[str, Any]:
    """One planner's answer to one problem: seconds (wall and CPU), verdict, fault of its times, path length."""
    wall, cpu = time.perf_counter(), time.process_time()
    answer = plan(problem, deadline)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    feasible = checker.feasible(entry)
    verdict = answer.status
    if answer.status == "success":
        verdict = checker.judge(entry, answer.waypoints)
    path = np.array(answer.waypoints)
    timed = verdict == "ok" and len(answer.times) > 0
    late = SolveConfig().acceleration_time
    return {
        "set": problem.set,
        "index": problem.index,
        "seconds": wall,
        "cpu_seconds": cpu,
        "feasible": feasible,
        "verdict": verdict,
        "times": checker.times_fault(entry, answer.waypoints, answer.times, late) or "ok"
        if timed
        else "none",
        "duration": answer.times[-1] if timed else None,
        "length": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) if len(path) else None,
    }


def key(result: dict[str, Any]) -> tuple[str, str, str, int]:
    """What makes a result unique."""
    return result["robot"], result["planner"], result["set"], result["index"]


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of a results file; none where there is none."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def table(robot: str, results: list[dict[str, Any]]) -> str:
    """Success of the feasible problems, times, lengths and the weakest set of every planner, as Markdown."""
    mine = [r for r in results if r["robot"] == robot]
    apart = {(r["set"], r["index"]): r["feasible"] for r in mine if r["feasible"] != "ok"}
    lines = [
        f"**{robot}**: {len({(r['set'], r['index']) for r in mine})} problems, {len(apart)} of which are infeasible "
        "for the checker" + "".join(f"; {name} {i}: {why}" for (name, i), why in sorted(apart.items())),
        "",
        "| planner | solved | weakest set | median [s] | p95 [s] | median CPU [s] | path | motion [s] | times ok |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for planner in dict.fromkeys(r["planner"] for r in mine):
        judged = [r for r in mine if r["planner"] == planner and r["feasible"] == "ok"]
        good = [r for r in judged if r["verdict"] == "ok"]
        total, solved = Counter(r["set"] for r in judged), Counter(r["set"] for r in good)
        weakest = min(total, key=lambda name: solved[name] / total[name])
        median, p95 = np.quantile([r["seconds"] for r in judged], [0.5, 0.95])
        cpu = np.median([r["cpu_seconds"] for r in judged])
        length = np.median([r["length"] for r in good]) if good else np.nan
        timed = [r for r in good if r["times"] != "none"]
        motion = f"{np.median([r['duration'] for r in timed]):.2f}" if timed else ""
        kept = f"{sum(r['times'] == 'ok' for r in timed)}/{len(timed)}" if timed else ""
        lines.append(
            f"| {planner} | {len(good)}/{len(judged)} | {weakest} {solved[weakest]}/{total[weakest]} | {median:.4f} | "
            f"{p95:.3f} | {cpu:.4f} | {length:.2f} | {motion} | {kept} |"
        )
    return "\n".join(lines)


def picture(results: list[dict[str, Any]], path: Path) -> None:
    """Share of the feasible problems solved within a time, one line a planner, one panel a robot.

    CPU time, since other work on the machine does not change it; no planner here uses a second core.
    """
    names = list(dict.fromkeys(r["robot"] for r in results))
    figure, axes = plt.subplots(1, len(names), figsize=(5.5 * len(names), 4), squeeze=False, sharey=True)
    for axis, robot in zip(axes[0], names, strict=True):
        for planner in dict.fromkeys(r["planner"] for r in results if r["robot"] == robot):
            judged = [
                r for r in results if (r["robot"], r["planner"], r["feasible"]) == (robot, planner, "ok")
            ]
            seconds = sorted(r["cpu_seconds"] for r in judged if r["verdict"] == "ok")
            if not seconds:
                continue
            share = 100 * np.arange(1, len(seconds) + 1) / len(judged)
            longest = max(r["cpu_seconds"] for r in judged)
            axis.step([*seconds, longest], [*share, *share[-1:]], where="post", label=planner)
        axis.set(xscale="log", xlabel="CPU time of one core [s]", title=robot, ylim=(0, 101))
        axis.grid(alpha=0.3)
        axis.legend(loc="upper left")
    axes[0, 0].set_ylabel("feasible problems solved and checked [%]")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    tyro.cli(Planning).run()
