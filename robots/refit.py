"""How the sphere sets in `robots/data` are made; run again after a change of a robot or of the fitter.

TIAGo's set was made by an earlier fitter. It is kept because navigation was tuned with it, and is coarser than what
`refit("tiago")` returns.
"""

from __future__ import annotations

from robots.errors import UnknownRobotError
from robots.registry import DATA, available, fetch_urdf, panda_urdf, tiago_urdf, ur5_urdf
from robots.robot_fitting import RobotFitConfig, fit_robot
from robots.sphere_fitting import SphereFit
from robots.spheres import SphereSet, save_spheres

# Wheels and casters lie within the base's outline; the tool link is a 5 mm marker inside of the wrist.
TIAGO_SKIPPED = (
    "wheel_left_link",
    "wheel_right_link",
    *(f"caster_{end}_{side}_2_link" for end in ("front", "back") for side in ("left", "right")),
    "arm_tool_link",
)
# The column slides inside of the lifting torso, whose shell is wider; the shoulder never gets at it, but the
# coarse box that stands for the column overlaps the shoulder's hull when the torso is down.
TIAGO_IGNORED = (("torso_fixed_column_link", "arm_1_link"), ("torso_fixed_column_link", "arm_2_link"))
TIAGO_BASE_HEIGHT = 0.0985  # [m] of base_link above the floor
FLOOR_TOLERANCE = 0.015  # [m] that base spheres may reach below the floor


def refit(name: str, save: bool = False) -> tuple[SphereSet, dict[str, SphereFit]]:
    """Fit the spheres of a ready-made robot anew; returns them with the quality of each body's fit.

    `save` overwrites the set that `robots.load` uses. Raises `UnknownRobotError`.
    """
    if name == "tiago":
        spheres, report = fit_robot(
            tiago_urdf(),
            90,
            skip=TIAGO_SKIPPED,
            lowest={"base_link": -TIAGO_BASE_HEIGHT - FLOOR_TOLERANCE},
            floor_links=["base_link"],
            ignored_pairs=TIAGO_IGNORED,
        )
    elif name == "panda":
        spheres, report = fit_robot(panda_urdf(), 240, floor_links=["panda_link0"])
    elif name == "fetch":
        # The arm works close to the base and the torso: no coarse spheres on the body that stands still.
        config = RobotFitConfig(static_factor=1.2)
        spheres, report = fit_robot(fetch_urdf(), 400, floor_links=["base_link"], config=config)
    elif name == "ur5":
        spheres, report = fit_robot(ur5_urdf(), 180, floor_links=["base_link"])
    else:
        raise UnknownRobotError(f"no robot is called {name!r}; available: {', '.join(available())}")
    if save:
        save_spheres(DATA / f"{name}_spheres.yaml", spheres)
    return spheres, report
