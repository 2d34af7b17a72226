"""Robot models for planning: URDFs, collision spheres, inverse kinematics and self filtering.

The pybullet world that stands in for the real one is the subpackage `robots.simulation`, which has to be
imported by name, since it needs a simulator.
"""

import sys
from importlib.util import find_spec
from pathlib import Path

if find_spec("pytorch_kinematics") is None:
    lacking = (
        "robots needs pytorch-kinematics, which is not installed: pip install 'isdf-planning[robots]' for the models, "
        "or 'isdf-planning[simulation]' for the simulator too"
    )
    # The command, which imports this first, says so in one line.
    raise SystemExit(lacking) if Path(sys.argv[0]).stem == "robots" else ModuleNotFoundError(lacking)

from robots.errors import (
    RobotError,
    SceneError,
    SphereFileError,
    UnknownJointError,
    UnknownLinkError,
    UnknownRobotError,
    UrdfError,
)
from robots.gripper import Gripper
from robots.inverse_kinematics import IkConfig, IkSolution
from robots.kinematic_tree import KinematicTree
from robots.link_pairs import PairConfig
from robots.model import Robot
from robots.registry import available, load
from robots.robot_fitting import RobotFitConfig, fit_robot
from robots.self_filter import remove_robot
from robots.sphere_fitting import SphereFit, fit_spheres
from robots.spheres import SphereSet, load_spheres, save_spheres
from robots.swept_base import SweptBase
from robots.urdf import Attachment, PlanarBase, compose, extract_subtree

__all__ = [
    "Attachment",
    "Gripper",
    "IkConfig",
    "IkSolution",
    "KinematicTree",
    "PairConfig",
    "PlanarBase",
    "Robot",
    "RobotError",
    "RobotFitConfig",
    "SceneError",
    "SphereFileError",
    "SphereFit",
    "SphereSet",
    "SweptBase",
    "UnknownJointError",
    "UnknownLinkError",
    "UnknownRobotError",
    "UrdfError",
    "available",
    "compose",
    "extract_subtree",
    "fit_robot",
    "fit_spheres",
    "load",
    "load_spheres",
    "remove_robot",
    "save_spheres",
]
