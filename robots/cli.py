"""The `robots` command: fit collision spheres to a robot, check a set of them."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

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
class Fit:
    """Cover a robot's collision geometry with spheres, and find the link pairs that need no self-collision test.

    Meshes are covered by way of their convex hulls, as physics engines collide them. Writes the spheres and the
    pairs (cuRobo's layout) and a picture beside them. Exit code 1 where more than 2 mm stay uncovered.
    """

    urdf: tyro.conf.Positional[Path]
    """The robot's URDF."""
    out: Path
    """The YAML file to write; the picture gets the same name with .png."""
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

    def run(self) -> bool:
        """Fit, write and report."""
        if not 0 <= self.gap <= MAX_UNCOVERED:
            raise RobotError(f"--gap is {self.gap} m, it must lie between 0 and {MAX_UNCOVERED} m")
        config = RobotFitConfig(gap=self.gap, seed=self.seed)
        spheres, report = fit_robot(
            self.urdf, self.budget, skip=self.skip, floor_links=self.floor_links, config=config
        )
        self.out.parent.mkdir(parents=True, exist_ok=True)
        save_spheres(self.out, spheres)
        picture = self.out.with_suffix(".png")
        save_sphere_figure(picture, Robot.from_urdf(self.urdf, spheres))
        print(_fit_table(report))
        worst = max(fit.max_uncovered for fit in report.values())
        print(f"{len(spheres)} spheres, {len(spheres.ignored_pairs)} link pairs that need no test")
        print(f"wrote {self.out} and {picture}")
        return worst <= MAX_UNCOVERED


@dataclass(frozen=True)
class Check:
    """Compare spheres with the collision geometry (pybullet's convex hulls) in random configurations.

    Reports coverage and overshoot, how often spheres and hulls disagree about self-collision, and which link pairs
    the file leaves untested. Exit code 1 where geometry stands out of the spheres, or contacts are missed, by more
    than 2 mm.
    """

    robot: tyro.conf.Positional[str]
    """A URDF, or the name of a ready-made robot (fetch, panda, tiago, ur5)."""
    spheres: tyro.conf.Positional[Path | None] = None
    """The sphere file (YAML in cuRobo's layout); by default the ready-made robot's own."""
    configurations: int = 200
    """Number of random configurations."""
    write_pairs: bool = False
    """Compute the pairs that need no test anew and write them into the sphere file."""
    seed: int = 0
    """Seed of configurations and samples."""

    def run(self) -> bool:
        """Check and report."""
        robot = self._robot()
        result = check_spheres(robot, self.configurations, self.seed)
        print(_fit_table(result.bodies))
        print(_check_text(robot, result))
        reasons = pair_reasons(robot)
        counts = Counter(reasons.values())
        print(
            f"pairs that need no test: {len(reasons)} ("
            + ", ".join(f"{counts[reason]} {reason}" for reason in ("adjacent", "always", "never"))
            + f"); the file names {len(robot.sphere_set.ignored_pairs)}"
        )
        if self.write_pairs:
            assert self.spheres is not None
            save_spheres(self.spheres, replace(robot.sphere_set, ignored_pairs=frozenset(reasons)))
            print(f"wrote the pairs into {self.spheres}")
        return result.safe

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


Command = Annotated[Fit, tyro.conf.subcommand("fit")] | Annotated[Check, tyro.conf.subcommand("check")]


def main() -> None:
    """Entry point of the `robots` command; exit code 1 for unsafe spheres, 2 for bad input."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    torch.set_num_threads(1)
    command = tyro.cli(Command, prog="robots", description="Collision spheres for robots.")  # type: ignore[arg-type]
    try:
        good = command.run()
    except RobotError as error:
        print(f"robots: {error}", file=sys.stderr)
        sys.exit(2)
    sys.exit(0 if good else 1)
