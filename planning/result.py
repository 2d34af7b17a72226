"""What planning returns: a status, the trajectory, and how it was reached."""

from __future__ import annotations

import enum
import html
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


@dataclass(frozen=True, eq=False, repr=False)
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

    def __repr__(self) -> str:
        facts = "".join(f", {name} {value}" for name, value in self._facts())
        return f"<PlanResult: {self.status.value}{facts}>"

    def _repr_html_(self) -> str:
        """For notebooks: a table, in red where the trajectory must not be driven."""
        colour = "green" if self.success else "red"
        rows = "".join(
            f"<tr><td>{name}</td><td>{html.escape(value)}</td></tr>"
            for name, value in [*self._facts(), ("message", self.message)]
        )
        return f'<b style="color:{colour}">{html.escape(self.status.value)}</b><table>{rows}</table>'

    def _facts(self) -> list[tuple[str, str]]:
        return [
            ("clearance", f"{100 * self.clearance:.1f} cm"),
            ("waypoints", f"{len(self.trajectory)} in {self.trajectory.duration:.2f} s"),
            ("iterations", str(self.iterations)),
            ("planned in", f"{self.seconds:.3f} s"),
        ]

    @property
    def success(self) -> bool:
        """True if the trajectory passed the dense check."""
        return self.status is Status.SUCCESS
