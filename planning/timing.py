"""Times for a path under velocity and acceleration limits."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from planning.errors import ConfigError
from planning.trajectory import Trajectory

MIN_DURATION = 0.1  # [s], of a trajectory that does not move
MIN_POINTS = 60  # of the speed profile; fewer waypoints are subdivided
CURVATURE_SHARE = 0.5  # of the acceleration limits, for turning; the rest is for speeding up and braking


def retime(
    trajectory: Trajectory,
    velocity_limits: Float[Tensor, " dof"],
    acceleration_limits: Float[Tensor, " dof"],
) -> Trajectory:
    """Give a path the fastest times from rest to rest that a trapezoidal speed profile within the limits
    allows.

    The speed along the joint path starts and ends at zero, keeps every joint's velocity limit, slows down
    where the path turns, and speeds up and brakes at no more than the accelerations left. The path itself is
    unchanged: when it has few waypoints, more are put on its segments.

    Args:
        trajectory: its waypoints are used, its times are not.
        velocity_limits: (dof,) [rad/s | m/s], positive; inf where there is none.
        acceleration_limits: (dof,) [rad/s^2 | m/s^2], positive; inf where there is none.

    Returns:
        A trajectory from time 0 whose segment velocities, and their differences over half the two segments'
        times (from rest at the first and to rest at the last waypoint), keep the limits. Its times are
        float64, since rounding them would break the limits.

    Raises:
        ConfigError: if limits are not positive, are not one a joint, or leave a moving joint unlimited.
    """
    v_max, a_max = (x.double() for x in (velocity_limits, acceleration_limits))
    for name, limits in (("velocity_limits", v_max), ("acceleration_limits", a_max)):
        if len(limits) != trajectory.num_dofs or not (limits > 0).all():
            raise ConfigError(
                f"retime: {name} must be {trajectory.num_dofs} positive numbers, one a joint, "
                f"got {limits.tolist()}."
            )
    path = _subdivided(trajectory.waypoints)
    if len(path) == 1:
        still = path.expand(2, -1).clone()
        return Trajectory(still, torch.tensor([0.0, MIN_DURATION], dtype=torch.float64))
    exact = path.double()
    ds = exact.diff(dim=0).norm(dim=1)
    tangent = exact.diff(dim=0) / ds[:, None]
    speed = _speed_profile(ds, _speed_limit(ds, tangent, v_max, a_max), _tangential_limit(tangent, a_max))
    if not torch.isfinite(speed).all():
        raise ConfigError("retime: a joint that moves has neither a velocity nor an acceleration limit.")
    dt = 2 * ds / (speed[:-1] + speed[1:])
    return Trajectory(path, torch.cat([dt.new_zeros(1), dt.cumsum(0)]) * (1 + 1e-9))  # a hair for rounding


def _subdivided(waypoints: Float[Tensor, "n dof"]) -> Float[Tensor, "m dof"]:
    """The path without repeated waypoints, with points added on its segments if it has few."""
    moved = torch.cat([torch.ones(1, dtype=torch.bool), waypoints.diff(dim=0).norm(dim=1) > 1e-9])
    path = waypoints[moved]
    if len(path) == 1 or len(path) >= MIN_POINTS:
        return path
    lengths = path.diff(dim=0).norm(dim=1)
    spacing = float(lengths.sum()) / MIN_POINTS
    parts = []
    for start, end, length in zip(path[:-1], path[1:], lengths.tolist(), strict=True):
        count = max(1, math.ceil(length / spacing))
        parts.append(torch.lerp(start, end, (torch.arange(count) / count).to(path)[:, None]))
    return torch.cat([*parts, path[-1:]])


def _speed_limit(
    ds: Float[Tensor, " e"],
    tangent: Float[Tensor, "e dof"],
    v_max: Float[Tensor, " dof"],
    a_max: Float[Tensor, " dof"],
) -> Float[Tensor, " e+1"]:
    """Path speed allowed at each waypoint by the velocities and by how sharply the path turns around it."""
    segment = (v_max / tangent.abs()).amin(dim=1)
    limit = torch.full((len(ds) + 1,), torch.inf, dtype=ds.dtype)
    limit[:-1] = segment
    limit[1:] = torch.minimum(limit[1:], segment)
    turn = tangent.diff(dim=0).abs()
    # Turning at waypoint i takes at most max(speed)^2 |turn| / min(ds), speeds taken at i-1, i and i+1.
    corner = (CURVATURE_SHARE * a_max * torch.minimum(ds[:-1], ds[1:])[:, None] / turn).amin(dim=1).sqrt()
    for part in (limit[:-2], limit[1:-1], limit[2:]):
        torch.minimum(part, corner, out=part)
    return limit


def _tangential_limit(tangent: Float[Tensor, "e dof"], a_max: Float[Tensor, " dof"]) -> Float[Tensor, " e"]:
    """Acceleration along the path allowed on each segment, given its tangent and its neighbours'."""
    steepest = tangent.abs().clone()
    steepest[1:] = torch.maximum(steepest[1:], tangent[:-1].abs())
    steepest[:-1] = torch.maximum(steepest[:-1], tangent[1:].abs())
    return (1 - CURVATURE_SHARE) * (a_max / steepest).amin(dim=1)


def _speed_profile(
    ds: Float[Tensor, " e"], limit: Float[Tensor, " m"], acceleration: Float[Tensor, " e"]
) -> Float[Tensor, " m"]:
    """The fastest path speeds from rest to rest: speeding up forwards, then braking backwards."""
    squares = limit.square().tolist()
    gains = (2 * acceleration * ds).tolist()
    squares[0] = squares[-1] = 0.0
    for i, gain in enumerate(gains):
        squares[i + 1] = min(squares[i + 1], squares[i] + gain)
    for i in range(len(gains) - 1, -1, -1):
        squares[i] = min(squares[i], squares[i + 1] + gains[i])
    return torch.tensor(squares, dtype=ds.dtype).sqrt()
