"""A trajectory: joint configurations with times, linear in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from planning.errors import TrajectoryError

if TYPE_CHECKING:
    from planning.joint_figure import JointFigure


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Waypoints in joint space with their times, joined by straight lines.

    Args:
        waypoints: (n, dof) configurations [rad | m], n >= 1, finite. Continuous joints are real numbers: a
            turn from 3.1 to 3.2 rad is written so, not as 3.1 to -3.08.
        times: (n,) [s], finite and strictly increasing.

    Raises:
        TrajectoryError: if the waypoints or times break these rules.
    """

    waypoints: Float[Tensor, "n dof"]
    times: Float[Tensor, " n"]

    def __post_init__(self) -> None:
        if len(self.waypoints) == 0:
            raise TrajectoryError("Trajectory: got 0 waypoints; at least 1 is needed.")
        bad = ~torch.isfinite(self.waypoints).all(dim=1)
        if bad.any():
            i = int(bad.nonzero()[0])
            raise TrajectoryError(
                f"Trajectory: waypoint {i} is {self.waypoints[i].tolist()}; every joint value must be "
                "finite. Check the inverse kinematics or the state estimate it came from."
            )
        if not torch.isfinite(self.times).all():
            raise TrajectoryError(f"Trajectory: times must be finite, got {self.times.tolist()}.")
        steps = self.times.diff()
        if (steps <= 0).any():
            i = int((steps <= 0).nonzero()[0])
            raise TrajectoryError(
                f"Trajectory: times must increase strictly, but times[{i}] = {float(self.times[i]):g} s and "
                f"times[{i + 1}] = {float(self.times[i + 1]):g} s; drop repeated waypoints or retime."
            )

    @classmethod
    def line(
        cls,
        start: Float[Tensor, " dof"],
        goal: Float[Tensor, " dof"],
        num_waypoints: int = 50,
        duration: float = 5.0,
    ) -> Trajectory:
        """Straight line in joint space from start to goal [rad | m] at even times over `duration` [s]."""
        return cls.through(torch.stack([start, goal]), num_waypoints, duration)

    @classmethod
    def through(
        cls, path: Float[Tensor, "k dof"], num_waypoints: int | None = None, duration: float = 5.0
    ) -> Trajectory:
        """Trajectory along a path of configurations at constant joint-space speed.

        Args:
            path: (k, dof) configurations [rad | m], k >= 1.
            num_waypoints: waypoints spread evenly by arc length (this cuts corners between them); None keeps
                the vertices of the path and only gives them times.
            duration: [s], positive.
        """
        if duration <= 0:
            raise TrajectoryError(f"Trajectory: duration must be positive, got {duration:g} s.")
        if num_waypoints is not None and num_waypoints < 1:
            raise TrajectoryError(f"Trajectory: num_waypoints must be at least 1, got {num_waypoints}.")
        lengths = path.diff(dim=0).norm(dim=1)
        if num_waypoints is None:
            moved = torch.cat([lengths.new_ones(1), lengths]) > 0
            path, lengths = path[moved], lengths[lengths > 0]
            if len(path) == 1:
                return cls(path, path.new_zeros(1))
        arc = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
        if num_waypoints is None:
            return cls(path, arc / arc[-1] * duration)
        fractions = torch.linspace(0, 1, num_waypoints, dtype=path.dtype, device=path.device)
        waypoints = _interpolate(arc, path, fractions * arc[-1])
        if num_waypoints > 1:
            waypoints[-1] = path[-1]  # exactly, whatever the rounding
        return cls(waypoints, fractions * duration)

    def __len__(self) -> int:
        return len(self.waypoints)

    def __repr__(self) -> str:
        start, goal = (_posture(self.waypoints[i]) for i in (0, -1))
        return (
            f"<Trajectory: {len(self)} waypoints of {self.num_dofs} joints in {self.duration:.2f} s, "
            f"from {start} to {goal}>"
        )

    def plot(self, names: Sequence[str] = ()) -> JointFigure:
        """A figure of all joints over time; notebooks show it inline. `names` label the curves."""
        from planning.joint_figure import joint_figure

        return joint_figure(self, names)

    def _repr_png_(self) -> bytes:
        return self.plot()._repr_png_()

    @property
    def num_dofs(self) -> int:
        """Number of joints."""
        return self.waypoints.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last waypoint [s]."""
        return float(self.times[-1] - self.times[0])

    @property
    def joint_path_length(self) -> float:
        """Sum of the Euclidean lengths of the joint-space segments [rad | m]."""
        return float(self.waypoints.diff(dim=0).norm(dim=1).sum())

    def at(self, t: float | Float[Tensor, "*batch"]) -> Float[Tensor, "*batch dof"]:
        """Configurations at times t [s], linear between waypoints, clamped to the ends."""
        return _interpolate(self.times, self.waypoints, torch.as_tensor(t).to(self.times))

    def resampled(self, num_waypoints: int) -> Trajectory:
        """The same motion sampled at `num_waypoints` even times; first and last waypoint stay exact."""
        if num_waypoints < 2:
            raise TrajectoryError(
                f"Trajectory.resampled: num_waypoints must be at least 2, got {num_waypoints}."
            )
        if len(self) == 1:
            raise TrajectoryError("Trajectory.resampled: one waypoint has no duration; use Trajectory.line.")
        fractions = torch.linspace(0, 1, num_waypoints, dtype=self.times.dtype, device=self.times.device)
        times = self.times[0] + fractions * (self.times[-1] - self.times[0])
        times[-1] = self.times[-1]
        return Trajectory(self.at(times), times)


def _posture(q: Float[Tensor, " dof"]) -> str:
    return "(" + " ".join(f"{value:.2f}" for value in q.tolist()) + ")"


def _interpolate(
    knots: Float[Tensor, " n"], values: Float[Tensor, "n dof"], at: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch dof"]:
    """Piecewise-linear interpolation of values over non-decreasing knots, clamped to the ends."""
    if len(knots) == 1:
        return values[0].expand(*at.shape, -1).clone()
    right = torch.searchsorted(knots, at.contiguous()).clamp(1, len(knots) - 1)
    left = right - 1
    width = knots[right] - knots[left]
    weight = ((at - knots[left]) / width.clamp_min(torch.finfo(knots.dtype).tiny)).clamp(0, 1)
    return torch.lerp(values[left], values[right], weight.to(values).unsqueeze(-1))
