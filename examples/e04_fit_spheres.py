"""4. From a URDF to a robot made of spheres that a planner can use.

    python -m examples.e04_fit_spheres my_robot.urdf --out runs/e04/spheres.yaml --budget 120

Without a URDF it takes the UR5 of the package example-robot-data. `robots fit` and `robots check` do the same on the
command line; in a notebook, `robot` shows its spheres.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tqdm import tqdm

import planning
import robots
from robots.checking import check_spheres
from robots.registry import ur5_urdf
from robots.sphere_figure import save_sphere_figure


@dataclass(frozen=True)
class FitSpheres:
    """Fit spheres to a robot, check them and plan with them."""

    urdf: tyro.conf.Positional[Path | None] = None
    """The robot; the UR5 by default."""
    out: Path = Path("runs/e04/spheres.yaml")
    """The sphere file to write; a picture gets the same name with .png."""
    budget: int = 60
    """Greatest number of spheres; more of them protrude less."""
    configurations: int = 50
    """Random configurations to check the spheres in."""


def main(options: FitSpheres) -> robots.Robot:
    """Fit, check, plan; returns the robot."""
    torch.set_num_threads(1)
    urdf = options.urdf or ur5_urdf()
    with tqdm(desc="fitting spheres", total=options.budget, disable=None) as bar:
        spheres, report = robots.fit_robot(
            urdf, options.budget, progress=lambda done, _: bar.update(done - bar.n)
        )
    robot = robots.Robot.from_urdf(urdf, spheres)
    print(robot)
    for body, fit in report.items():
        print(
            f"  {body}: {len(fit.spheres)} spheres, {fit.coverage:.1%} of the surface covered, they overshoot by "
            f"{1000 * fit.overshoot_mean:.0f} mm in the mean and {1000 * fit.overshoot_max:.0f} mm at most"
        )

    # The physics engine's hulls are the judge: a set that misses a contact by more than 2 mm is not safe.
    checked = check_spheres(robot, options.configurations)
    print(
        f"{checked.configurations} random configurations: {checked.hull_collisions} collide with themselves; the "
        f"spheres say so of {checked.sphere_collisions} and miss {checked.misses}: "
        + ("safe" if checked.safe else "NOT SAFE, give more spheres")
    )

    options.out.parent.mkdir(parents=True, exist_ok=True)
    robots.save_spheres(options.out, spheres)
    save_sphere_figure(options.out.with_suffix(".png"), robot)

    # From here on it is a robot like the ready-made ones: it plans from rest, among a ball 2 m away.
    again = robots.Robot.from_urdf(urdf, options.out)
    start = again.rest
    goal = torch.lerp(start, again.joint_limits[:, 1].clamp(max=3.0), 0.2)
    field = planning.PrimitiveField([planning.Solid("sphere", (0.3,), (2.0, 0.0, 0.5))])
    print(planning.Planner(again).plan(start, goal, field))
    return again


if __name__ == "__main__":
    chosen = tyro.cli(FitSpheres, description=__doc__)
    main(chosen)
    print(f"spheres and picture: {chosen.out}, {chosen.out.with_suffix('.png')}")
