"""The one exception tree of the package: everything raised on purpose derives from `RobotError`."""

from __future__ import annotations


class RobotError(ValueError):
    """Something given to the robots package is not usable; the message names it and the fix."""


class UnknownLinkError(RobotError):
    """A link is named that the robot does not have."""


class UnknownJointError(RobotError):
    """A joint is named that the robot does not have, or that cannot be planned."""


class UnknownRobotError(RobotError):
    """A robot is asked for that the registry does not know."""


class SphereFileError(RobotError):
    """A collision-sphere file is missing, malformed or does not fit the robot."""


class UrdfError(RobotError):
    """A URDF is missing, malformed, or cannot be composed as asked."""


class SceneError(RobotError):
    """A simulated scene is malformed or refers to something that does not exist."""
