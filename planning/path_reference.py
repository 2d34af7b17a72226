"""Progress along a planar path, and the stretch of it that lies ahead in time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from planning.errors import TrajectoryError

LOOK_AHEAD = 0.6  # [m] of path searched ahead for the nearest point, so that crossing paths are not mixed up
TANGENT_SPAN = 0.05  # [m] of path over which its direction is measured, so that single kinks do not matter


def wrapped(angle: float) -> float:
    """The angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


@dataclass(frozen=True)
class MotionLimits:
    """What bounds the speed along a path: speed [m/s], braking [m/s^2] and yaw rate in bends [rad/s]."""

    speed: float
    braking: float
    yaw_rate: float


class PathReference:
    """A path with a speed profile, and how far along it the base is.

    Args:
        path: (n, 2) positions [m], finite; repeated ones are dropped.
        times: (n,) [s], strictly increasing, or None.
        cruise: speed [m/s] where there are no times; a fifth of it is the least anywhere.
        motion: what bounds the speed.

    Raises:
        TrajectoryError: if path or times are malformed.
    """

    def __init__(
        self,
        path: Float[ndarray, "n 2"],
        times: Float[ndarray, " n"] | None,
        cruise: float,
        motion: MotionLimits,
    ) -> None:
        if len(path) == 0 or not np.isfinite(path).all():
            raise TrajectoryError(
                f"path: at least one position is needed and all must be finite, got {path.tolist()}."
            )
        if times is not None and not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise TrajectoryError(f"path: times must be finite and increase strictly, got {times.tolist()}.")
        moved = np.r_[True, np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-6]
        self._points = path[moved].astype(float)
        lengths = np.linalg.norm(np.diff(self._points, axis=0), axis=1)
        self._arc = np.r_[0.0, np.cumsum(lengths)]
        # A pause at a position is left out: the base would only wait there.
        wanted = np.full(len(lengths), cruise) if times is None else lengths / np.diff(times)[moved[1:]]
        self._grid, self._speeds = self._speed_profile(wanted, motion, slowest=0.2 * cruise)
        self._progress = 0.0

    @property
    def end(self) -> Float[ndarray, " 2"]:
        """Last position [m]."""
        return self._points[-1]

    @property
    def length(self) -> float:
        """[m]."""
        return float(self._arc[-1])

    @property
    def near_end(self) -> bool:
        """Whether the end is within the stretch searched ahead, and not only nearby."""
        return self.length - self._progress < LOOK_AHEAD

    def advance(self, position: Float[ndarray, " 2"]) -> None:
        """Move on to the point nearest to a position; never back."""
        ahead = np.linspace(self._progress, min(self._progress + LOOK_AHEAD, self.length), 121)
        self._progress = float(ahead[np.linalg.norm(self._at(ahead) - position, axis=1).argmin()])

    def ahead(self, distance: float) -> Float[ndarray, "n 2"]:
        """The positions [m] that lie more than a distance [m] ahead on the path; at least the last one."""
        far = np.flatnonzero(self._arc > self._progress + distance)
        return self._points[far if len(far) else [-1]]

    def heading(self) -> float:
        """Direction [rad] of the path where the base is."""
        return float(self._directions(np.array([self._progress]))[0])

    def past_end(self, position: Float[ndarray, " 2"]) -> bool:
        """Whether a position lies beyond the last one, seen along the path's last direction."""
        direction = float(self._directions(np.array([self.length]))[0])
        offset = position - self.end
        return bool(offset[0] * math.cos(direction) + offset[1] * math.sin(direction) > 0)

    def horizon(self, steps: int, period: float, yaw: float) -> Float[ndarray, "3 steps"]:
        """x, y, yaw after each of the next steps of a period [s]; yaw is unwrapped from the given one."""
        arcs, arc = np.empty(steps), self._progress
        for k in range(steps):
            arc = min(arc + self._speed(arc) * period, self.length)
            arcs[k] = arc
        yaws = np.unwrap(np.r_[yaw, self._directions(arcs)])[1:]
        return np.vstack([self._at(arcs).T, yaws])

    def _speed(self, arc: float) -> float:
        return min(
            float(np.interp(arc, self._grid, self._speeds)), (2 * self._braking * (self.length - arc)) ** 0.5
        )

    def _speed_profile(
        self, wanted: Float[ndarray, " e"], motion: MotionLimits, slowest: float
    ) -> tuple[Float[ndarray, " g"], Float[ndarray, " g"]]:
        """Speeds on a grid of arc lengths: as wanted, slower in bends, braking ahead of them."""
        self._braking = motion.braking
        if len(wanted) == 0:
            return np.zeros(1), np.zeros(1)
        grid = np.linspace(0.0, self.length, max(2, math.ceil(self.length / 0.02) + 1))
        segment = np.clip(np.searchsorted(self._arc, grid, side="right") - 1, 0, len(wanted) - 1)
        bend = np.abs(np.gradient(np.unwrap(self._directions(grid)))) / (grid[1] - grid[0])
        speeds = np.minimum(
            np.minimum(wanted[segment], motion.speed), motion.yaw_rate / np.maximum(bend, 1e-6)
        )
        speeds = np.maximum(speeds, slowest)  # a profile from rest would never set off
        for i in range(len(grid) - 2, -1, -1):
            reachable = math.sqrt(speeds[i + 1] ** 2 + 2 * motion.braking * (grid[i + 1] - grid[i]))
            speeds[i] = min(speeds[i], reachable)
        return grid, speeds

    def _at(self, arcs: Float[ndarray, " k"]) -> Float[ndarray, "k 2"]:
        return np.stack([np.interp(arcs, self._arc, self._points[:, i]) for i in (0, 1)], axis=1)

    def _directions(self, arcs: Float[ndarray, " k"]) -> Float[ndarray, " k"]:
        ahead = np.minimum(arcs + TANGENT_SPAN / 2, self.length)
        behind = np.maximum(ahead - TANGENT_SPAN, 0.0)
        step = self._at(ahead) - self._at(behind)
        return np.arctan2(step[:, 1], step[:, 0])
