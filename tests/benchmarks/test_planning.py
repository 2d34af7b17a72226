"""The planning benchmark: its checker on paths that are known to be good or bad, its table, and going on."""

import gzip
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import robots
from benchmarks import planning as benchmark
from benchmarks.planning_check import Checker
from benchmarks.planning_rivals import PLANNERS, Answer, checked_robot
from planning import Trajectory, retime
from planning.problems import load_problems

READY = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]


@pytest.fixture(scope="module")
def panda():
    return robots.load("panda")


@pytest.fixture(scope="module")
def checker(panda):
    return Checker(checked_robot("panda", panda))


def _entry(panda, goal=0.6, box=(0.1, 0.1, 0.1), at=(-0.7, 0.0, 0.2)):
    return {
        "set": "s",
        "index": 1,
        "joints": list(panda.joint_names),
        "start": READY,
        "goal": [goal, *READY[1:]],
        "obstacles": [
            {"type": "box", "dimensions": list(box), "position": list(at), "quat_xyzw": [0, 0, 0, 1]}
        ],
    }


def _line(entry, n=30):
    return np.linspace(entry["start"], entry["goal"], n)


def test_paths_are_judged(panda, checker):
    entry = _entry(panda)
    line = _line(entry)
    assert checker.feasible(entry) == "ok" and checker.judge(entry, line) == "ok"
    assert checker.judge(entry, line[1:]) == "start differs"
    assert checker.judge(entry, line[:-3]) == "goal missed"
    assert checker.judge(entry, [[float("nan")] * 7] * 2) == "malformed"
    x, y = 0.31 * np.cos(0.3), 0.31 * np.sin(0.3)  # where the hand passes halfway
    assert "in an obstacle" in checker.judge(_entry(panda, box=(0.05, 0.05, 1.5), at=(x, y, 0.4)), line)
    assert "beyond its limits" in checker.judge(_entry(panda, goal=3.2), _line(_entry(panda, goal=3.2), 90))
    folded = {**entry, "goal": [0.6, -1.7, 0.0, -3.0, 0.0, 0.0, 0.785]}
    assert " in " in checker.feasible({**folded, "goal": [0.6, 0.0, 0.0, -3.05, 0.0, 0.2, 0.785]})


def test_times_are_judged(panda, checker):
    entry = _entry(panda)
    limits = panda.velocity_limits.double()
    timed = retime(Trajectory.through(torch.from_numpy(_line(entry))), limits, limits / 0.5)
    path, times = timed.waypoints.tolist(), timed.times
    assert checker.times_fault(entry, path, times.tolist(), 0.5) == ""
    assert "too fast" in checker.times_fault(entry, path, (0.2 * times).tolist(), 1e-3)
    assert "too hard" in checker.times_fault(entry, path, (0.95 * times).tolist(), 0.5)
    assert checker.times_fault(entry, path, (0 * times).tolist(), 0.5) == "times malformed"
    assert checker.times_fault(entry, path, times.tolist()[1:], 0.5) == "times malformed"


def test_a_run_goes_on_where_it_ended(panda, tmp_path, monkeypatch):
    folder = tmp_path / "motionbenchmaker"
    folder.mkdir()
    entries = [{**_entry(panda), "index": i} for i in (1, 2)] + [{**_entry(panda, goal=3.2), "index": 3}]
    (folder / "panda_problems.json.gz").write_bytes(gzip.compress(json.dumps({"problems": entries}).encode()))
    asked = []

    def straight(name, robot):
        def plan(problem, deadline):
            asked.append(problem.index)
            line = np.linspace(problem.start.numpy(), problem.goal.numpy(), 20)
            return Answer(line.tolist(), np.linspace(0, 9, 20).tolist(), "success")

        return plan

    def missing(name, robot):
        raise ImportError("not here")

    monkeypatch.setitem(PLANNERS, "ours", straight)
    monkeypatch.setitem(PLANNERS, "vamp", missing)
    study = benchmark.Planning(out=tmp_path / "out", data=tmp_path, planners=("ours", "vamp"), limit=1)
    study.run()
    replace(study, limit=3).run()
    assert asked == [1, 1, 2, 2, 3]  # the first one of a run is also the warm-up
    text = (tmp_path / "out" / "table.md").read_text()
    assert "3 problems, 1 of which are infeasible" in text and "| ours | 2/2 |" in text
    assert (tmp_path / "out" / "success.png").stat().st_size > 0


@pytest.mark.parametrize("name", ["ompl", "tesseract"])
def test_rivals_solve_what_the_checker_passes(name, panda, checker, tmp_path):
    """Each with an obstacle beside the straight line, then with one that the hand has to pass over."""
    pytest.importorskip({"tesseract": "tesseract_robotics"}.get(name, name))
    plan = PLANNERS[name]("panda", panda)
    x, y = 0.31 * np.cos(0.3), 0.31 * np.sin(0.3)
    for entry in (_entry(panda), _entry(panda, box=(0.05, 0.05, 0.2), at=(x, y, 0.4))):
        path = tmp_path / "problems.json"
        path.write_text(json.dumps({"problems": [entry]}))
        answer = plan(load_problems(path)[0], 5.0)
        assert answer.status == "success"
        assert checker.judge(entry, answer.waypoints) == "ok"
    assert checker.judge(entry, _line(entry)) != "ok"
