"""The `robots` command: fit collision spheres to a robot, check a set of them."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import json
import logging
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NoReturn

import torch
import tyro
from tqdm import tqdm

from robots.checking import MAX_UNCOVERED, SphereCheck, check_spheres
from robots.errors import RobotError, UnknownRobotError
from robots.link_pairs import pair_reasons
from robots.model import Robot
from robots.registry import available, load
from robots.robot_fitting import RobotFitConfig, fit_robot
from robots.sphere_figure import save_sphere_figure
from robots.sphere_fitting import SphereFit
from robots.spheres import save_spheres


@dataclass(frozen=True)
class Outcome:
    """What a command found: whether the spheres are safe, in words and for machines."""

    safe: bool
    text: str
    data: dict[str, Any]


@dataclass(frozen=True)
class Fit:
    """Cover a robot with spheres; find the link pairs that need no test."""

    urdf: tyro.conf.Positional[Path]
    """The robot's URDF. Meshes are covered by way of their convex hulls, as physics engines collide them."""
    out: Path
    """The YAML file to write, in cuRobo's layout; a picture gets the same name with .png."""
    budget: int = 200
    """Greatest number of spheres. More protrude less: an arm takes 60 for 2-3 cm, 240 for 1 cm at most."""
    gap: float = 0.001
    """How far geometry may stand out of the spheres [m]; cutting corners by a millimetre saves many spheres."""
    skip: tuple[str, ...] = ()
    """Links to leave out, e.g. wheels inside of the base's outline."""
    floor_links: tuple[str, ...] = ()
    """Links that stand or drive on the floor."""
    seed: int = 0
    """Seed of all samples."""
    json: bool = False
    """Print the outcome as one line of JSON."""

    def run(self) -> Outcome:
        """Fit, write and report."""
        if not 0 <= self.gap <= MAX_UNCOVERED:
            raise RobotError(f"--gap is {self.gap} m, it must lie between 0 and {MAX_UNCOVERED} m")
        config = RobotFitConfig(gap=self.gap, seed=self.seed)
        with _bar("fitting spheres") as progress:
            spheres, report = fit_robot(
                self.urdf,
                self.budget,
                skip=self.skip,
                floor_links=self.floor_links,
                config=config,
                progress=progress,
            )
        self.out.parent.mkdir(parents=True, exist_ok=True)
        save_spheres(self.out, spheres)
        picture = self.out.with_suffix(".png")
        save_sphere_figure(picture, Robot.from_urdf(self.urdf, spheres))
        worst = max(fit.max_uncovered for fit in report.values())
        pairs = len(spheres.ignored_pairs)
        lines = [
            _fit_table(report),
            f"{len(spheres)} spheres, {pairs} link pairs that need no test",
            f"wrote {self.out} and {picture}",
        ]
        data = {"files": [str(self.out), str(picture)], "spheres": len(spheres), "untested_pairs": pairs}
        return Outcome(bool(worst <= MAX_UNCOVERED), "\n".join(lines), data | {"bodies": _fit_data(report)})


@dataclass(frozen=True)
class Check:
    """Compare spheres with collision geometry in random configurations."""

    robot: tyro.conf.Positional[str]
    """A URDF, or the name of a ready-made robot (fetch, panda, tiago, ur5)."""
    spheres: tyro.conf.Positional[Path | None] = None
    """The sphere file (YAML in cuRobo's layout); by default the ready-made robot's own."""
    configurations: int = 200
    """Number of random configurations, in which pybullet's convex hulls are the judge."""
    write_pairs: bool = False
    """Compute the pairs that need no test anew and write them into the sphere file."""
    seed: int = 0
    """Seed of configurations and samples."""
    json: bool = False
    """Print the outcome as one line of JSON."""

    def run(self) -> Outcome:
        """Check and report."""
        robot = self._robot()
        with _bar("checking configurations") as progress:
            result = check_spheres(robot, self.configurations, self.seed, progress)
        reasons = pair_reasons(robot)
        counts = Counter(reasons.values())
        lines = [
            _fit_table(result.bodies),
            _check_text(robot, result),
            f"pairs that need no test: {len(reasons)} ("
            + ", ".join(f"{counts[reason]} {reason}" for reason in ("adjacent", "always", "never"))
            + f"); the file names {len(robot.sphere_set.ignored_pairs)}",
        ]
        if self.write_pairs:
            assert self.spheres is not None
            save_spheres(self.spheres, replace(robot.sphere_set, ignored_pairs=frozenset(reasons)))
            lines.append(f"wrote the pairs into {self.spheres}")
        numbers = {f.name: getattr(result, f.name) for f in dataclasses.fields(result)}
        data = numbers | {"bodies": _fit_data(result.bodies), "untested_pairs": len(reasons)}
        return Outcome(result.safe, "\n".join(lines), data)

    def _robot(self) -> Robot:
        if self.write_pairs and self.spheres is None:
            raise RobotError("--write-pairs needs a sphere file to write into; name one after the robot")
        if Path(self.robot).is_file():
            if self.spheres is None:
                raise RobotError(f"{self.robot} is a URDF: name the sphere file to check after it")
            return Robot.from_urdf(self.robot, self.spheres)
        if self.robot not in available():
            raise UnknownRobotError(
                f"{self.robot!r} is neither a file nor a ready-made robot; those are {', '.join(available())}"
            )
        robot = load(self.robot)
        return robot if self.spheres is None else robot.with_spheres(self.spheres)


@contextlib.contextmanager
def _bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar, where there is a terminal, that is told the work done and the whole."""
    with tqdm(desc=title, disable=None, leave=False) as bar:

        def progress(done: int, whole: int) -> None:
            bar.total = whole
            bar.update(done - bar.n)

        yield progress


def _fit_data(fits: Mapping[str, SphereFit]) -> dict[str, dict[str, float | int]]:
    """The same as `_fit_table` for machines; lengths in metres."""
    names = ("coverage", "max_uncovered", "overshoot_mean", "overshoot_p95", "overshoot_max")
    return {
        body: {"spheres": len(fit.spheres)} | {name: float(getattr(fit, name)) for name in names}
        for body, fit in fits.items()
    }


def _fit_table(fits: Mapping[str, SphereFit]) -> str:
    """One line a body, lengths in millimetres."""
    lines = [
        f"{'body':24}{'spheres':>8}{'covered':>10}{'uncovered':>11}{'overshoot mean':>16}{'95 %':>7}{'max':>7}  [mm]"
    ]
    for name, fit in fits.items():
        lengths = (fit.overshoot_mean, fit.overshoot_p95, fit.overshoot_max)
        mean, p95, most = (1e3 * length for length in lengths)
        lines.append(
            f"{name:24}{len(fit.spheres):8d}{fit.coverage:10.2%}{1e3 * fit.max_uncovered:11.1f}"
            f"{mean:16.1f}{p95:7.1f}{most:7.1f}"
        )
    return "\n".join(lines)


def _check_text(robot: Robot, result: SphereCheck) -> str:
    count = result.configurations
    wrong = result.false_alarms + result.misses
    lines = [
        f"{len(robot.sphere_links)} spheres, {count} random configurations: {result.hull_collisions} with the hulls in "
        f"self-collision, {result.sphere_collisions} with the spheres",
        f"  verdicts differ in {wrong} ({wrong / count:.1%}): {result.false_alarms} false alarms, "
        f"{result.misses} misses, the deepest by {1e3 * result.worst_miss:.1f} mm",
        f"  posed by the URDF: {result.coverage:.2%} covered, at most {1e3 * result.max_uncovered:.1f} mm uncovered",
    ]
    if result.uncovered_links:
        lines.append(f"  links with geometry but no spheres: {', '.join(result.uncovered_links)}")
    return "\n".join(lines)


COMMANDS: dict[str, type] = {"fit": Fit, "check": Check}

Command = Annotated[Fit, tyro.conf.subcommand("fit")] | Annotated[Check, tyro.conf.subcommand("check")]

# tyro joins lines that are not indented.
DESCRIPTION = """Collision spheres for robots.
  robots fit ROBOT.urdf --out SPHERES.yaml --budget 200   spheres for your robot
  robots check ROBOT.urdf SPHERES.yaml                    are they safe?
  robots check panda                                      a ready-made robot's
  robots COMMAND --help                                   options of a command
  --json: outcome or error as one line of JSON on stdout or stderr
  exit codes:
    0     done
    1     geometry stands out of the spheres, or contacts are missed, by more
          than 2 mm; or a file could not be written, or a bug
    2     bad input, an unknown command or an unknown option
    130   stopped by Ctrl-C"""


def main() -> None:
    """Entry point of the `robots` command; what goes wrong is said in one line, see `DESCRIPTION` for exit codes."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    torch.set_num_threads(1)
    words = sys.argv[1:]
    try:
        if words and not words[0].startswith("-") and words[0] not in COMMANDS:
            close = difflib.get_close_matches(words[0], COMMANDS, n=1, cutoff=0.4)
            guess = f"did you mean {close[0]}? " if close else ""
            raise RobotError(
                f"there is no command {words[0]!r}; {guess}The commands are {', '.join(COMMANDS)}"
            )
        command = tyro.cli(Command, prog="robots", description=DESCRIPTION)  # type: ignore[arg-type]
        outcome = command.run()
        data = {"safe": outcome.safe} | outcome.data
        print(json.dumps(data) if command.json else outcome.text, flush=True)
    except RobotError as error:
        _fail(2, error)
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        _fail(1, error)
    except KeyboardInterrupt:
        _fail(130, InterruptedError("stopped by Ctrl-C"))
    sys.exit(0 if outcome.safe else 1)


def _fail(code: int, error: Exception) -> NoReturn:
    as_json = "--json" in sys.argv
    line = json.dumps({"error": type(error).__name__, "message": str(error)})
    print(line if as_json else f"robots: {error}", file=sys.stderr)
    sys.exit(code)
