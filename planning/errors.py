"""The exceptions of `planning`: wrong inputs only; not finding a trajectory is a status in the result."""

from __future__ import annotations


class PlanningError(ValueError):
    """Base of every error raised by `planning`."""


class TrajectoryError(PlanningError):
    """A trajectory, path or configuration that is malformed or does not fit the robot."""


class ConfigError(PlanningError):
    """A configuration value, or a set of limits, outside what is accepted."""


class FieldError(PlanningError):
    """An object given as a field that offers neither distances nor costs."""


class SolverError(PlanningError):
    """A numerical solver that could not be built or that failed on a well-posed problem."""


class ProblemError(PlanningError):
    """A file of planning problems, or a robot named for it, that cannot be used."""
