"""Hard equality constraints on trajectories, kept by projection in the metric (CHOMP, section 3.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from planning.metric import Metric

PoseOf = Callable[[Tensor], Tensor]
"""Maps configurations (..., dof) to a link's poses (..., 4, 4), differentiable by autograd."""


@runtime_checkable
class Constraint(Protocol):
    """A function h of the configuration that must be zero."""

    @property
    def goal_only(self) -> bool:
        """Whether only the last waypoint is constrained, which the constraint then stands for."""
        ...

    def residual(self, q: Float[Tensor, "m dof"]) -> Float[Tensor, "m k"]:
        """h(q), differentiable by autograd [rad | m]."""
        ...


@dataclass(frozen=True)
class GoalPose:
    """The last waypoint puts a link at a pose; about the link's `free_axis` (0, 1 or 2) it may be turned as it likes.

    Args:
        pose_of: the link's poses.
        target: (4, 4) [m], world frame.
        free_axis: of the link; None for none.
    """

    pose_of: PoseOf
    target: Float[Tensor, "4 4"]
    free_axis: int | None = None
    goal_only: bool = True

    def residual(self, q: Float[Tensor, "m dof"]) -> Float[Tensor, "m k"]:
        """Offset [m] and turn [rad, small angles] from the target, in the target's frame."""
        pose, target = self.pose_of(q), self.target.to(q)
        offset = (pose[..., :3, 3] - target[:3, 3]) @ target[:3, :3]
        relative = target[:3, :3].T @ pose[..., :3, :3]
        if self.free_axis is not None:
            across = [i for i in range(3) if i != self.free_axis]
            turn = _sines(
                relative[..., across, self.free_axis], relative[..., self.free_axis, self.free_axis]
            )
        else:
            twist = relative - relative.transpose(-1, -2)
            turn = 0.5 * torch.stack([twist[..., 2, 1], twist[..., 0, 2], twist[..., 1, 0]], dim=-1)
            turn = _sines(turn, relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
        return torch.cat([offset, turn], dim=-1)


@dataclass(frozen=True)
class AxisConstraint:
    """An axis of a link keeps a direction all the way: a cup stays upright.

    Args:
        pose_of: the link's poses.
        axis: (3,) unit axis in the link's frame.
        direction: (3,) unit direction in the world.
    """

    pose_of: PoseOf
    axis: Float[Tensor, "3"]
    direction: Float[Tensor, "3"]
    goal_only: bool = False

    def residual(self, q: Float[Tensor, "m dof"]) -> Float[Tensor, "m 2"]:
        """The axis' components across the direction (sines of angles)."""
        turned = self.pose_of(q)[..., :3, :3] @ self.axis.to(q)
        helper = torch.eye(3).to(q)[int(self.direction.abs().argmin())]
        first = torch.linalg.cross(self.direction.to(q), helper)
        first = first / first.norm()
        second = torch.linalg.cross(self.direction.to(q), first)
        return _sines(turned @ torch.stack([first, second], dim=1), turned @ self.direction.to(q))


def _sines(sines: Float[Tensor, "m k"], cosine: Float[Tensor, " m"]) -> Float[Tensor, "m k"]:
    """Sines of a turn, of length one beyond a right angle, so that the opposite direction is no solution."""
    size = sines.norm(dim=-1, keepdim=True)
    anywhere = torch.eye(sines.shape[-1]).to(sines)[0]  # at half a turn every way back is as good
    unit = torch.where(size > 1e-6, sines / size.clamp_min(1e-6), anywhere)
    return torch.where((cosine < 0).unsqueeze(-1), unit, sines)


def linearised(
    constraint: Constraint, q: Float[Tensor, "m dof"]
) -> tuple[Float[Tensor, "m k"], Float[Tensor, "m k dof"]]:
    """h and its Jacobian at configurations."""
    states = q.detach().requires_grad_()
    with torch.enable_grad():
        h = constraint.residual(states)
        rows = [torch.autograd.grad(h[:, i].sum(), states, retain_graph=True)[0] for i in range(h.shape[1])]
    return h.detach(), torch.stack(rows, dim=1)


def violation(constraints: Sequence[Constraint], q: Float[Tensor, "n dof"]) -> float:
    """Largest |h| over the waypoints that constraints apply to."""
    with torch.no_grad():
        parts = [c.residual(q[-1:] if c.goal_only else q).abs().max() for c in constraints]
    return float(torch.stack(parts).max()) if parts else 0.0


def project_to_constraints(
    q: Float[Tensor, "n dof"],
    metric: Metric,
    constraints: Sequence[Constraint],
    iterations: int = 4,
    tolerance: float = 1e-5,
) -> Float[Tensor, "n dof"]:
    """Bring waypoints onto the constraints by the least motion in the metric; the start stays.

    Gauss-Newton: q <- q - A^-1 C^T (C A^-1 C^T)^-1 h, with C the stacked Jacobian (CHOMP, equation 27).
    """
    interior = torch.arange(len(q))[metric.interior]
    for _ in range(iterations):
        places, jacobians, values = [], [], []
        for constraint in constraints:
            at = interior[-1:] if constraint.goal_only else interior
            h, jacobian = linearised(constraint, q[at])
            places.append((at - 1).repeat_interleave(h.shape[1]))
            jacobians.append(jacobian.flatten(0, 1))
            values.append(h.flatten())
        place, c, h = torch.cat(places), torch.cat(jacobians).double(), torch.cat(values).double()
        if not constraints or h.abs().max() <= tolerance:
            break
        system = metric.inverse[place][:, place] * (c @ c.T)
        damping = 1e-9 * system.diagonal().max() * torch.eye(len(h), dtype=torch.float64)
        multipliers = torch.linalg.solve(system + damping, h)
        spread = torch.zeros(len(interior), q.shape[1], dtype=torch.float64)
        spread.index_add_(0, place, multipliers[:, None] * c)
        step = metric.inverse @ spread
        step = step * min(1.0, 0.5 / float(step.abs().max()))  # linear only nearby
        q = q.clone()
        q[metric.interior] -= step.to(q)
    return q
