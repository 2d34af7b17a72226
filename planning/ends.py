"""Start and goal before anything is planned: whether they are valid, and the nearest configuration that is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from planning.protocols import CostField, DistanceField, SphereRobot
from planning.result import Status
from planning.trajectory import Trajectory
from planning.validation import Validation, ValidationConfig, check, check_dofs, free_states, within_limits
from planning.workspace import Workspace

RADII = [0.01 * 1.5**k for k in range(14)]  # [rad | m] looked at around a blocked configuration, up to 2
DIRECTIONS = 64  # at each radius
ROUNDS = 12  # of looking for one that is nearer than the first one found
SPREAD = 0.5  # [rad] of the directions looked into then
NEAREST_SECONDS = 0.5  # most time spent on the search for a free configuration

REPAIRABLE = (Status.START_IN_COLLISION, Status.GOAL_IN_COLLISION, Status.JOINT_LIMITS)


def check_ends(
    robot: SphereRobot,
    trajectory: Trajectory,
    sdf: DistanceField | CostField,
    config: ValidationConfig | None = None,
) -> Validation:
    """Test the start and the goal only; what no optimiser can repair."""
    check_dofs(robot, trajectory)
    start, goal = (
        check(robot, Trajectory(trajectory.waypoints[i : i + 1], trajectory.times[i : i + 1]), sdf, config)
        for i in (0, len(trajectory) - 1)
    )
    if start.status is Status.START_IN_COLLISION and _is_flat(robot, trajectory.waypoints[0], sdf):
        message = "the field is the same, without any slope, all over the robot: is it a map of nothing?"
        return replace(start, status=Status.INVALID_FIELD, message=message)
    if not start.success or goal.success:
        return start
    status = Status.GOAL_IN_COLLISION if goal.status is Status.START_IN_COLLISION else goal.status
    message = "goal " + goal.message.removeprefix("at waypoint 0 of 1 ")
    return replace(goal, status=status, message=message, waypoint=len(trajectory) - 1)


def nearest_free(
    robot: SphereRobot,
    q: Float[Tensor, " dof"],
    sdf: DistanceField | CostField,
    config: ValidationConfig | None = None,
    seconds: float = NEAREST_SECONDS,
    seed: int = 0,
) -> Float[Tensor, " dof"] | None:
    """A free configuration near a blocked one, to start from instead; None if none is found in time.

    Looks around in growing circles, along single joints and in random directions, and then for nearer ones about the
    first that is free.

    Args:
        robot: whose configuration it is.
        q: blocked, or outside the joint limits.
        sdf: what blocks it.
        config: what is free.
        seconds: wall time after which the search ends.
        seed: of the directions.
    """
    config, ends_at = config or ValidationConfig(), time.perf_counter() + seconds
    workspace = Workspace(robot, sdf, eps=1.0, config=config.workspace)
    low, high = robot.joint_limits.to(q).unbind(dim=1)
    inside = q.clamp(low, high)

    def free(states: Tensor) -> Tensor:
        return within_limits(robot, states) & free_states(robot, workspace, states, config)

    if free(inside[None])[0]:
        return inside
    generator = torch.Generator().manual_seed(seed)
    joints = torch.cat([torch.eye(len(q)), -torch.eye(len(q))]).to(q)
    for radius in RADII:
        if time.perf_counter() > ends_at:
            return None
        anywhere = torch.randn(DIRECTIONS, len(q), generator=generator).to(q)
        around = torch.cat([joints, anywhere / anywhere.norm(dim=1, keepdim=True)])
        candidates = (inside + radius * around).clamp(low, high)
        found = candidates[free(candidates)]
        if len(found):
            return _nearer(inside, found[int((found - inside).norm(dim=1).argmin())], free, generator)
    return None


def offered(
    robot: SphereRobot,
    trajectory: Trajectory,
    verdict: Validation,
    sdf: DistanceField | CostField,
    config: ValidationConfig,
    seconds: float | None,
) -> tuple[str, Float[Tensor, " dof"] | None]:
    """The verdict's message on blocked ends, and the nearest free configuration, which it then names.

    With no more than `seconds` [s] left, where they are given.
    """
    left = NEAREST_SECONDS if seconds is None else min(NEAREST_SECONDS, seconds)
    if verdict.status not in REPAIRABLE or left <= 0:
        return verdict.message, None
    which = 0 if verdict.waypoint == 0 else -1
    nearest = nearest_free(robot, trajectory.waypoints[which], sdf, config, left)
    if nearest is None:
        return f"{verdict.message}; no free configuration was found near it", None
    values = ", ".join(f"{value:.4g}" for value in nearest.tolist())
    name = "start" if which == 0 else "goal"
    return f"{verdict.message}; the nearest free {name} found is [{values}] (nearest_free)", nearest


def _nearer(
    inside: Float[Tensor, " dof"],
    found: Float[Tensor, " dof"],
    free: Callable[[Tensor], Tensor],
    generator: torch.Generator,
) -> Float[Tensor, " dof"]:
    """A free configuration nearer to `inside` than the one found: closer by on the way to it, or somewhat aside."""
    for _ in range(ROUNDS):
        way = found - inside
        length = way.norm()
        aside = torch.randn(DIRECTIONS, len(way), generator=generator).to(way) * (SPREAD / len(way) ** 0.5)
        aside[: DIRECTIONS // 4] = 0.0
        ahead = way / length + aside
        shorter = 1 - 0.3 * torch.rand(DIRECTIONS, 1, generator=generator).to(way)
        candidates = inside + length * shorter * ahead / ahead.norm(dim=1, keepdim=True)
        candidates = candidates[free(candidates)]
        if len(candidates):
            found = candidates[int((candidates - inside).norm(dim=1).argmin())]
    return found


def _is_flat(robot: SphereRobot, q: Float[Tensor, " dof"], sdf: DistanceField | CostField) -> bool:
    """Whether a field is one number without slope at all spheres of a configuration and around them."""
    field = sdf.field if isinstance(sdf, CostField) else sdf
    with torch.no_grad():
        centres, radii = robot.spheres(q)
        sides = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).to(q)
        points = centres[:, None] + radii[:, None, None] * sides
    distance, gradient = field.distance_and_gradient(points)
    same = math.isclose(float(distance.max()), float(distance.min()), abs_tol=1e-9)
    return same and bool((gradient == 0).all())
