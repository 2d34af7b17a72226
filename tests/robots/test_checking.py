"""The check finds spheres that are too small or too large, by pybullet's hulls, and the command says so."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import robots
from robots.checking import check_spheres
from robots.cli import main
from robots.link_pairs import PairConfig, pair_reasons

Run = Callable[..., tuple[int, str, str]]

FIT_PROGRESS: list[tuple[int, ...]] = []
BAR = '<collision><origin xyz="0 0 0.15"/><geometry><box size="0.04 0.04 0.3"/></geometry></collision>'
HINGE = (
    '<joint name="j{1}" type="revolute"><origin xyz="0 0 0.35"/><parent link="{0}"/><child link="{1}"/>'
    '<axis xyz="0 1 0"/><limit lower="-2.9" upper="2.9" effort="1" velocity="1"/></joint>'
)


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bars") / "bars.urdf"
    links = "".join(f'<link name="{name}">{BAR}</link>' for name in ("a", "b", "c"))
    path.write_text(f'<robot name="bars">{links}{HINGE.format("a", "b")}{HINGE.format("b", "c")}</robot>')
    return path


@pytest.fixture(scope="module")
def fitted(urdf: Path) -> robots.Robot:
    config = robots.RobotFitConfig(pairs=PairConfig(samples=500))
    spheres, _ = robots.fit_robot(urdf, 36, config=config, progress=lambda *told: FIT_PROGRESS.append(told))
    return robots.Robot.from_urdf(urdf, spheres)


def resized(robot: robots.Robot, factor: float, change: float) -> robots.Robot:
    rows = {
        link: spheres * np.array([1, 1, 1, factor]) + np.array([0, 0, 0, change])
        for link, spheres in robot.sphere_set.spheres.items()
    }
    return robot.with_spheres(replace(robot.sphere_set, spheres=rows))


def test_good_spheres_pass(fitted: robots.Robot) -> None:
    result = check_spheres(fitted, 100)
    assert result.safe and result.max_uncovered < 2e-3
    assert result.hull_collisions > 5
    assert result.false_alarms < 0.1 * result.configurations
    assert not result.uncovered_links


def test_small_spheres_miss_contacts_and_large_ones_invent_them(fitted: robots.Robot) -> None:
    small, large = (check_spheres(resized(fitted, *change), 100) for change in ((0.1, 0.0), (1.0, 0.04)))
    assert not small.safe and small.max_uncovered > 8e-3
    assert small.misses > 0 and small.worst_miss > 0
    assert large.safe and large.misses == 0
    assert large.false_alarms > check_spheres(fitted, 100).false_alarms
    assert large.bodies["b"].overshoot_mean > 0.03


def test_misplaced_spheres_are_found(fitted: robots.Robot) -> None:
    rows = {link: s + np.array([0.03, 0, 0, 0]) for link, s in fitted.sphere_set.spheres.items()}
    assert (
        check_spheres(fitted.with_spheres(replace(fitted.sphere_set, spheres=rows)), 5).max_uncovered > 0.015
    )


def test_reasons_of_untested_pairs(fitted: robots.Robot) -> None:
    reasons = pair_reasons(fitted, PairConfig(samples=500))
    assert reasons[frozenset("ab")] == reasons[frozenset("bc")] == "adjacent"
    assert frozenset("ac") not in reasons  # folded up, the last bar hits the first


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["robots", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0), *capsys.readouterr()

    return call


def test_the_command_fits_then_checks(run: Run, urdf: Path, tmp_path: Path) -> None:
    out = tmp_path / "spheres.yaml"
    code, text, _ = run("fit", str(urdf), "--out", str(out), "--budget", "24")
    assert code == 0 and "overshoot" in text
    assert len(robots.load_spheres(out)) <= 24 and out.with_suffix(".png").stat().st_size > 10_000
    code, text, _ = run("check", str(urdf), str(out), "--configurations", "20", "--json")
    told = json.loads(text)
    assert code == 0 and told["safe"] and told["configurations"] == 20 and told["max_uncovered"] < 2e-3
    assert sum(body["spheres"] for body in told["bodies"].values()) == len(robots.load_spheres(out))
    code, text, _ = run("check", str(urdf), str(out), "--configurations", "20")
    assert code == 0 and re.search(r"verdicts differ in \d+", text) and "2 adjacent" in text
    out.write_text(re.sub(r"radius: [\d.]+", "radius: 0.005", out.read_text()))
    assert run("check", str(urdf), str(out), "--configurations", "20")[0] == 1
    assert run("check", str(urdf), str(out), "--configurations", "20", "--write-pairs")[0] == 1
    assert {frozenset("ab"), frozenset("bc")} <= robots.load_spheres(out).ignored_pairs


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("check", "r2d2"), "panda"),
        (("check", "panda", "--write-pairs"), "sphere file"),
        (("fit", "nothing.urdf", "--out", "s.yaml"), "nothing.urdf"),
        (("fit", "nothing.urdf", "--out", "s.yaml", "--gap", "0.1"), "--gap"),
        (("chek", "panda"), "did you mean check?"),
    ],
)
def test_bad_requests_are_explained(run: Run, arguments: tuple[str, ...], message: str) -> None:
    code, out, error = run(*arguments)
    assert code == 2 and message in error and error.count("\n") == 1 and out == ""
    code, out, error = run(*arguments, "--json")
    assert code == 2 and message in json.loads(error)["message"] and out == ""


def test_a_misspelled_option_is_answered_with_the_right_one(run: Run) -> None:
    code, _, error = run("check", "panda", "--configuration", "5")
    assert code == 2 and "--configurations" in error


def test_progress_reaches_the_whole(fitted: robots.Robot) -> None:
    last = 3 + len(FIT_PROGRESS)  # one ball a body to begin with, then one after the other
    assert [(n, 36) for n in range(4, last + 1)] == FIT_PROGRESS and 20 < last <= 36
    told: list[tuple[int, int]] = []
    check_spheres(fitted, 6, progress=lambda *done: told.append(done))
    assert told == [(n, 6) for n in range(1, 7)]
