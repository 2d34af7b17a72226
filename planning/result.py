"""What planning returns: a status, the trajectory, and how it was reached."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from planning.trajectory import Trajectory


class Status(enum.Enum):
    """Verdict on a trajectory; only SUCCESS may be driven."""

    SUCCESS = "success"
    START_IN_COLLISION = "start in collision"
    GOAL_IN_COLLISION = "goal in collision"
    COLLISION = "collision"
    SELF_COLLISION = "self-collision"
    JOINT_LIMITS = "joint limits"
    INVALID_FIELD = "invalid field"
    UNKNOWN_SPACE = "unknown space"
    CONSTRAINT = "constraint violated"
    NO_PATH = "no path"


@dataclass(frozen=True, eq=False)
class PlanResult:
    """Outcome of planning. Failing is a status, not an exception.

    Args:
        trajectory: the best trajectory found, also when it is not valid.
        status: the verdict of the dense check, or NO_PATH.
        message: the reason in words, naming waypoint, link and depth.
        clearance: least distance [m] of the robot from obstacles along the trajectory; negative in collision,
            NaN if it was not measured.
        cost_history: total cost before each iteration of the optimiser.
        iterations: iterations of the optimiser.
        seconds: wall time [s].
        nearest_free: where start or goal is blocked, the nearest configuration (dof,) found that is not.
    """

    trajectory: Trajectory
    status: Status
    message: str
    clearance: float
    cost_history: tuple[float, ...]
    iterations: int
    seconds: float
    nearest_free: Float[Tensor, " dof"] | None = None

    @property
    def success(self) -> bool:
        """True if the trajectory passed the dense check."""
        return self.status is Status.SUCCESS
