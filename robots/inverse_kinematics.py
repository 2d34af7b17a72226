"""Batched inverse kinematics: damped least squares within joint limits, with random restarts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from robots.errors import RobotError, UnknownJointError
from robots.model import Robot
from robots.numbers import refuse_nan
from robots.self_collision import self_gaps


@dataclass(frozen=True)
class IkConfig:
    """How hard to try."""

    max_iterations: int = 100
    damping: float = 0.03  # [m, rad] residual scale below which steps are full Gauss-Newton steps
    max_step: float = 0.4  # [rad | m] of any joint in one iteration: the linearisation holds no further
    restart_spread: float = (
        1.0  # [rad | m] of the first half of the restarts about the seed; the rest is uniform
    )
    length: float = 0.3  # [m] an orientation error of 1 rad weighs as much as a position error of this

    def __post_init__(self) -> None:
        refuse_nan(self)


@dataclass(frozen=True)
class IkSolution:
    """The best configuration found for each target.

    `q` (n, dof) [rad | m]; `position_error` (n,) [m] and `orientation_error` (n,) [rad] at it, and whether
    both are within tolerance. Not converging is an answer, not an exception.
    """

    q: Float[Tensor, "n dof"]
    position_error: Float[Tensor, " n"]
    orientation_error: Float[Tensor, " n"]
    converged: Bool[Tensor, " n"]


def solve(
    robot: Robot,
    T_world_tool: Float[Tensor, "*batch 4 4"],
    q_seed: Float[Tensor, "*seeds dof"],
    *,
    joints: Sequence[str] | None = None,
    position_tolerance: float = 1e-3,
    orientation_tolerance: float = 1e-2,
    free_axis: int | None = None,
    num_seeds: int = 16,
    seed: int = 0,
    config: IkConfig | None = None,
) -> IkSolution:
    """Find configurations that bring the tool link to targets.

    Args:
        robot: any robot with a `tool_link`, also one made by `with_fixed`.
        T_world_tool: target poses (..., 4, 4) [m]; flattened to n targets.
        q_seed: start (dof,) or one a target (..., dof); joints that do not move keep these values.
        joints: the joints that may move; all by default.
        position_tolerance: [m].
        orientation_tolerance: [rad].
        free_axis: 0, 1 or 2 if the tool may turn about its own x, y or z axis.
        num_seeds: starts a target: the seed itself, then random ones within the limits.
        seed: of the random starts.
        config: step sizes and iterations.

    Of several converged starts the one nearest to the seed is returned, but one in which the robot touches itself only
    where all do. Raises `RobotError` for a robot without a tool link or badly shaped arguments, `UnknownJointError` for
    joints that are not planned.
    """
    config = config or IkConfig()
    if robot.tool_link is None:
        raise RobotError(f"{robot.name!r} has no tool_link to place; give one to Robot.from_urdf")
    if free_axis not in (None, 0, 1, 2):
        raise RobotError(f"free_axis is {free_axis!r}, accepted are None, 0 (x), 1 (y) and 2 (z) of the tool")
    if num_seeds < 1:
        raise RobotError(f"num_seeds is {num_seeds}, at least 1 start is needed")
    targets = T_world_tool.reshape(-1, 4, 4).to(q_seed)
    if q_seed.shape[-1] != robot.num_dofs:
        raise RobotError(
            f"q_seed has {q_seed.shape[-1]} joints, expected {robot.num_dofs}: {robot.joint_names}"
        )
    home = q_seed.reshape(-1, robot.num_dofs).expand(len(targets), -1)
    moving = _columns(robot, joints)
    lower, upper = robot.joint_limits.to(q_seed).unbind(-1)
    q = _starts(home, lower, upper, moving, num_seeds, config.restart_spread, seed)
    goals = targets[:, None].expand(-1, num_seeds, -1, -1).reshape(-1, 4, 4)
    q = _descend(robot, q.reshape(-1, robot.num_dofs), goals, moving, lower, upper, free_axis, config)
    with torch.no_grad():
        error = _residual(robot.link_poses(q, [robot.tool_link])[:, 0], goals, free_axis)
    position = error[:, :3].norm(dim=-1).view(-1, num_seeds)
    orientation = error[:, 3:].norm(dim=-1).view(-1, num_seeds)
    good = (position <= position_tolerance) & (orientation <= orientation_tolerance)
    q = q.view(len(targets), num_seeds, -1)
    # Behind all others rank the unconverged, by their error; before them postures in which the robot touches itself.
    way = (q - home[:, None]).norm(dim=-1)
    if num_seeds > 1:
        way += 1e3 * (self_gaps(robot, q.reshape(-1, robot.num_dofs)) < 0).view_as(way)
    rank = torch.where(good, way, 1e6 + position + config.length * orientation)
    best = rank.argmin(1, keepdim=True)
    chosen = q.gather(1, best[..., None].expand(-1, -1, q.shape[-1])).squeeze(1)
    return IkSolution(
        chosen, position.gather(1, best)[:, 0], orientation.gather(1, best)[:, 0], good.gather(1, best)[:, 0]
    )


def _columns(robot: Robot, joints: Sequence[str] | None) -> Tensor:
    names = robot.joint_names if joints is None else tuple(joints)
    unknown = [name for name in names if name not in robot.joint_names]
    if unknown or not names:
        raise UnknownJointError(
            f"cannot move joints {unknown or '(none given)'}; planned are {robot.joint_names}"
        )
    return torch.tensor([robot.joint_names.index(name) for name in names])


def _starts(
    home: Tensor, lower: Tensor, upper: Tensor, moving: Tensor, count: int, spread: float, seed: int
) -> Tensor:
    """Starts (n, count, dof): the seed, then starts about it, then starts anywhere within the limits."""
    generator = torch.Generator().manual_seed(seed)
    n, dof = home.shape
    starts = home[:, None].repeat(1, count, 1)
    noise = torch.rand(n, count, dof, generator=generator).to(home)
    near = home[:, None] + spread * (2 * noise - 1)
    # Unlimited and very wide joints (a base in a building) start within reach of the seed.
    low = torch.maximum(lower.expand_as(home), home - torch.pi)[:, None]
    high = torch.minimum(upper.expand_as(home), home + torch.pi)[:, None]
    anywhere = low + (high - low) * noise
    half = 1 + (count - 1) // 2
    starts[:, 1:half, moving] = near[:, 1:half, moving]
    starts[:, half:, moving] = anywhere[:, half:, moving]
    starts[..., moving] = starts[..., moving].clamp(lower[moving], upper[moving])
    return starts


def _descend(
    robot: Robot,
    q: Tensor,
    goals: Tensor,
    moving: Tensor,
    lower: Tensor,
    upper: Tensor,
    free_axis: int | None,
    config: IkConfig,
) -> Tensor:
    """Levenberg-Marquardt on all starts at once: a step that does not help is undone and damped more."""
    weight = torch.tensor([1.0] * 3 + [config.length] * 3).to(q)
    q = q.clone()
    damping = torch.full_like(q[:, :1], config.damping)
    residual, jacobian = _linearise(robot, q, goals, moving, free_axis)
    for _ in range(config.max_iterations):
        step = _step(residual * weight, jacobian * weight[:, None], q, moving, lower, upper, damping)
        step = step / (step.abs().amax(-1, keepdim=True) / config.max_step).clamp(min=1.0)
        trial = q.clone()
        trial[:, moving] = (q[:, moving] + step).clamp(lower[moving], upper[moving])
        trial_residual, trial_jacobian = _linearise(robot, trial, goals, moving, free_axis)
        better = ((trial_residual * weight).norm(dim=-1) < (residual * weight).norm(dim=-1))[:, None]
        q = torch.where(better, trial, q)
        residual = torch.where(better, trial_residual, residual)
        jacobian = torch.where(better[..., None], trial_jacobian, jacobian)
        damping = torch.where(better, damping * 0.5, damping * 4.0).clamp(1e-4, 10.0)
        if residual.norm(dim=-1).max() < 1e-5:
            break
    return q


def _step(
    residual: Tensor,
    jacobian: Tensor,
    q: Tensor,
    moving: Tensor,
    lower: Tensor,
    upper: Tensor,
    damping: Tensor,
) -> Tensor:
    """Damped least-squares step (n, m) in which joints pushed against a limit do not take part."""
    gradient = (jacobian.transpose(-1, -2) @ residual[..., None]).squeeze(-1)
    at_lower = (q[:, moving] <= lower[moving]) & (gradient < 0)
    at_upper = (q[:, moving] >= upper[moving]) & (gradient > 0)
    free = jacobian * ~(at_lower | at_upper)[:, None]
    # In float32 a small damping squared would vanish beside J J^T, and an arm at a singularity has no solution then.
    wide = free.double()
    normal = wide @ wide.transpose(-1, -2) + damping[..., None].double() ** 2 * torch.eye(6).to(wide)
    solved = torch.linalg.solve(normal, residual[..., None].double())
    return (wide.transpose(-1, -2) @ solved).squeeze(-1).to(q)


def _linearise(
    robot: Robot, q: Tensor, goals: Tensor, moving: Tensor, free_axis: int | None
) -> tuple[Tensor, Tensor]:
    """Residual (n, 6) from tool to goal and the tool's geometric Jacobian (n, 6, m) in world axes."""
    q = q.detach().requires_grad_()
    pose = robot.link_poses(q, [robot.tool_link or ""])[:, 0]
    rows = []
    for k in range(3):
        rows.append(torch.autograd.grad(pose[:, k, 3].sum(), q, retain_graph=True)[0][:, moving])
    # d R = [omega] R, so each component of omega is one entry of (d R) R^T.
    rotation = pose[:, :3, :3].detach()
    for first, second in ((2, 1), (0, 2), (1, 0)):
        turned = (pose[:, first, :3] * rotation[:, second]).sum()
        rows.append(torch.autograd.grad(turned, q, retain_graph=True)[0][:, moving])
    jacobian = torch.stack(rows, dim=1)
    pose = pose.detach()
    if free_axis is not None:
        # Turning about the tool's own axis costs nothing, so it must not be asked for either.
        axis = pose[:, :3, free_axis]
        along = (axis[:, None] @ jacobian[:, 3:]) * axis[..., None]
        jacobian = torch.cat([jacobian[:, :3], jacobian[:, 3:] - along], dim=1)
    return _residual(pose, goals, free_axis), jacobian


def _residual(pose: Tensor, goals: Tensor, free_axis: int | None) -> Tensor:
    """Translation [m] and rotation vector [rad] (n, 6) in world axes that bring a pose to its goal."""
    if free_axis is None:
        turn = _rotation_vector(goals[:, :3, :3] @ pose[:, :3, :3].transpose(-1, -2))
    else:
        axis, wanted = pose[:, :3, free_axis], goals[:, :3, free_axis]
        cross = torch.linalg.cross(axis, wanted)
        sine = cross.norm(dim=-1, keepdim=True)
        angle = torch.atan2(sine, (axis * wanted).sum(-1, keepdim=True))
        # Opposite axes leave the turning direction open; any normal of the axis does.
        other = torch.linalg.cross(axis, pose[:, :3, (free_axis + 1) % 3])
        turn = angle * torch.where(sine > 1e-6, cross / sine.clamp(min=1e-12), other)
    return torch.cat([goals[:, :3, 3] - pose[:, :3, 3], turn], dim=-1)


def _rotation_vector(rotation: Tensor) -> Tensor:
    """Axis times angle (n, 3) [rad] of rotation matrices; near half a turn through the symmetric part."""
    skew = torch.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        dim=-1,
    )
    sine, cosine = (
        skew.norm(dim=-1, keepdim=True) / 2,
        (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)[:, None] / 2,
    )
    angle = torch.atan2(sine, cosine)
    # R + R^T = 2 cos I + 2 (1 - cos) a a^T: its largest column is parallel to the axis where sin vanishes.
    outer = (rotation + rotation.transpose(-1, -2)) / 2 - cosine[..., None] * torch.eye(3).to(rotation)
    column = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    axis = outer.gather(2, column[:, None, None].expand(-1, 3, 1)).squeeze(-1)
    axis = axis / axis.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    axis = torch.where((axis * skew).sum(-1, keepdim=True) < 0, -axis, axis)
    small = sine < 1e-3
    regular = torch.where(small, skew / 2, skew / (2 * sine.clamp(min=1e-12)) * angle)
    return torch.where(small & (cosine < 0), axis * angle, regular)
