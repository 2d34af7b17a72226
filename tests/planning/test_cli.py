"""`python -m planning`: results for people and machines, faults in one line, and what Ctrl-C leaves."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from planning import cli
from planning.solve import Solver
from tests.planning.robots import Disc

Run = Callable[..., tuple[int, str, str]]
ENTRY = {
    "set": "shelf",
    "joints": ["base_x", "base_y"],
    "start": [0.0, 0.0],
    "goal": [1.0, 0.0],
    "obstacles": [{"type": "sphere", "dimensions": [0.2], "position": [0.5, 1.5, 0.0]}],
}
LOADER = "tests.planning.test_cli:disc"


def disc(name: str) -> object:
    return Disc()


@pytest.fixture
def problems(tmp_path: Path) -> Path:
    path = tmp_path / "problems.json"
    path.write_text(json.dumps({"problems": [ENTRY | {"index": i} for i in (1, 2, 3)]}))
    return path


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["planning", *map(str, words)])
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = int(end.code or 0)
        return code, *(text.strip() for text in capsys.readouterr())

    return call


def test_results_are_written_and_told_to_people_and_machines(
    run: Run, problems: Path, tmp_path: Path
) -> None:
    out = tmp_path / "deep" / "results.json"
    words = ("solve", problems, "--loader", LOADER, "--out", out)
    code, text, _ = run(*words, "--limit", 2)
    assert code == 0 and "shelf" in text and "2/2" in text
    assert [r["index"] for r in json.loads(out.read_text())] == [1, 2]
    code, text, _ = run(*words, "--json")
    told = json.loads(text)
    assert code == 0 and told["problems"] == told["solved"] == 3 and told["file"] == str(out)
    assert 0 < told["median_seconds"] <= told["p95_seconds"]


def test_ctrl_c_leaves_the_results_so_far(
    run: Run, problems: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve, calls = Solver.solve, []

    def interrupted(*arguments: object) -> dict:
        calls.append(1)
        if len(calls) == 4:  # the first call is for the caches
            raise KeyboardInterrupt
        return solve(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Solver, "solve", interrupted)
    out = tmp_path / "results.json"
    code, text, error = run("solve", problems, "--loader", LOADER, "--out", out)
    assert code == 130 and text == "" and error == "planning: stopped by Ctrl-C"
    assert [r["index"] for r in json.loads(out.read_text())] == [1, 2]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("solv",), 2, "the only one is solve"),
        (("solve", "nowhere.json"), 2, "nowhere.json"),
        (("solve", "PROBLEMS", "--loader", "tests.planning:nothing"), 2, "gives no robot"),
        (("solve", "PROBLEMS", "--loader", LOADER, "--out", "/proc/nowhere/r.json"), 1, "nowhere"),
    ],
)
def test_faults_are_one_line_for_people_and_one_for_machines(
    run: Run, problems: Path, words: tuple[str, ...], code: int, said: str
) -> None:
    arguments = [problems if word == "PROBLEMS" else word for word in words]
    found, out, error = run(*arguments)
    assert found == code and said in error and "\n" not in error and out == ""
    found, out, error = run(*arguments, "--json")
    assert found == code and said in json.loads(error)["message"] and out == ""


def test_a_misspelled_option_is_answered_with_the_right_one(run: Run, problems: Path) -> None:
    code, _, error = run("solve", problems, "--dedline", "1")
    assert code == 2 and "--deadline" in error
