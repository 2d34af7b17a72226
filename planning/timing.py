"""Times for a path under velocity and acceleration limits, by TOPP-RA (Pham and Pham, T-RO 2018)."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import CubicSpline
from torch import Tensor

from planning.errors import ConfigError
from planning.trajectory import Trajectory

MIN_DURATION = 0.1  # [s], of a trajectory that does not move
MIN_POINTS = 60  # of the path; fewer waypoints are subdivided
GRID = 4  # points a segment at which the speed along the path is decided
UNLIMITED = 1e9  # stands for a limit that a joint does not have [rad/s | rad/s^2 | m/s | m/s^2]


def retime(
    trajectory: Trajectory,
    velocity_limits: Float[Tensor, " dof"],
    acceleration_limits: Float[Tensor, " dof"],
) -> Trajectory:
    """Give a path the fastest times from rest to rest within the limits.

    The times are those at which TOPP-RA passes the waypoints on a cubic spline through them. Mean velocities and
    accelerations between waypoints are averages of the spline's, so they keep the limits, too; what the grid of
    TOPP-RA leaves of a violation is removed by slowing the whole down. The path itself, straight between its
    waypoints, is unchanged: when it has few waypoints, more are put on its segments.

    Args:
        trajectory: its waypoints are used, its times are not.
        velocity_limits: (dof,) [rad/s | m/s], positive; inf where there is none.
        acceleration_limits: (dof,) [rad/s^2 | m/s^2], positive; inf where there is none.

    Returns:
        A trajectory from time 0, longer than 0 s, whose segment velocities, and their differences over half the two
        segments' times (from rest at the first and to rest at the last waypoint), keep the limits. Its times are
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
    free = v_max.isinf() & a_max.isinf() & (exact != exact[0]).any(dim=0)
    if free.any():
        raise ConfigError(
            f"retime: joint {int(free.nonzero()[0])} moves and has neither a velocity nor an acceleration limit."
        )
    finite = (v_max.clamp_max(UNLIMITED).numpy(), a_max.clamp_max(UNLIMITED).numpy())
    times = torch.from_numpy(_fastest(exact.numpy(), *finite))
    return Trajectory(path, times * slowdown(exact, times, v_max, a_max))


def slowdown(
    path: Float[Tensor, "n dof"],
    times: Float[Tensor, " n"],
    velocity_limits: Float[Tensor, " dof"],
    acceleration_limits: Float[Tensor, " dof"],
) -> float:
    """By what factor (at least 1) times must be stretched to keep the limits, from rest to rest.

    Velocities are those of the segments, accelerations their differences over half the two segments' times.
    """
    dt = times.diff()[:, None]
    velocity = path.diff(dim=0) / dt
    rest = torch.zeros_like(velocity[:1])
    between = torch.cat([dt[:1], dt[:-1] + dt[1:], dt[-1:]]) / 2
    acceleration = torch.cat([rest, velocity, rest]).diff(dim=0) / between
    too_fast = float((velocity.abs() / velocity_limits).max())
    too_hard = float((acceleration.abs() / acceleration_limits).max())
    return max(1.0, too_fast, math.sqrt(too_hard)) * (1 + 1e-9)  # a hair for rounding


def _subdivided(waypoints: Float[Tensor, "n dof"]) -> Float[Tensor, "m dof"]:
    """The path without repeated waypoints, with points added on its segments if it has few."""
    moved = torch.cat([torch.ones(1, dtype=torch.bool), waypoints.diff(dim=0).norm(dim=1) > 1e-9])
    path = waypoints[moved]
    path[-1] = waypoints[-1]
    if len(path) == 1 or len(path) >= MIN_POINTS:
        return path
    lengths = path.diff(dim=0).norm(dim=1)
    spacing = float(lengths.sum()) / MIN_POINTS
    parts = []
    for start, end, length in zip(path[:-1], path[1:], lengths.tolist(), strict=True):
        count = max(1, math.ceil(length / spacing))
        parts.append(torch.lerp(start, end, (torch.arange(count) / count).to(path)[:, None]))
    return torch.cat([*parts, path[-1:]])


def _fastest(
    path: Float[ndarray, "n dof"], v_max: Float[ndarray, " dof"], a_max: Float[ndarray, " dof"]
) -> Float[ndarray, " n"]:
    """When TOPP-RA passes the waypoints on the cubic spline through them [s]."""
    from planning.compiled.topp import path_speeds

    knots = np.r_[0.0, np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()]
    spline = CubicSpline(knots, path, bc_type="natural")
    share = np.arange(GRID) / GRID
    grid = np.r_[(knots[:-1, None] + share * np.diff(knots)[:, None]).ravel(), knots[-1]]
    speed = np.sqrt(path_speeds(np.diff(grid), spline(grid, 1), spline(grid, 2), v_max, a_max))
    times = np.r_[0.0, (2 * np.diff(grid) / (speed[:-1] + speed[1:])).cumsum()]
    return times[::GRID]
