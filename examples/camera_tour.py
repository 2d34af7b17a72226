"""A robot that carries its camera through a room along ways it is told are free: what both recorders share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from examples.episode import Episode
from planning.grid_search import grid_search
from planning.path_reference import wrapped
from planning.position_costs import GridSearchConfig
from planning.tracking import BaseTracker, TrackerConfig

ROUTE = GridSearchConfig(margin=0.3)
SMOOTHING = 0.2
"""Length over which kinks of a route are rounded [m]: a base would slow down at each."""
LEG_TIME = 60.0
"""A leg takes less than this [s]."""


@dataclass(frozen=True)
class Leg:
    """One way to drive, and what to look at on it.

    Args:
        through: positions (x, y) [m] to pass; the base stops at the last.
        look_at: a piece of furniture or an object by name; None looks ahead, swaying as a robot that watches its way.
        final_yaw: heading [rad] to turn to at the end.
        speed: cruise speed [m/s].
        wander: how far the gaze wanders about what is looked at [m].
        linger: how long to stay [s], shifting a little to and fro as when lining up a grasp.
    """

    through: tuple[tuple[float, float], ...]
    look_at: str | None = None
    final_yaw: float | None = None
    speed: float = 0.4
    wander: float = 0.3
    linger: float = 0.0


class Gaze:
    """The direction of the camera, turned towards what is wanted as smoothly as a neck does it.

    A critically damped second-order filter of azimuth and elevation, limited in speed. What lies behind the robot is
    looked at as far round as the neck goes, and when it passes from one side to the other, the camera swings over the
    front.

    Args:
        yaw: azimuth to begin with [rad].
        frequency: of the filter [rad/s].
        max_rate: [rad/s].
        reach: of the neck to each side [rad]; TIAGo's ends at 1.31.
    """

    def __init__(
        self, yaw: float, frequency: float = 4.0, max_rate: float = 1.2, reach: float = 1.25
    ) -> None:
        self._angles, self._rates = np.array([yaw, -0.3]), np.zeros(2)
        self._frequency, self._max_rate, self._reach = frequency, max_rate, reach

    def towards(self, ray: np.ndarray, yaw: float, period: float) -> np.ndarray:
        """Direction (3,) after `period` [s] of turning towards a ray (3,) of any length on a base at `yaw` [rad]."""
        aside = np.clip(wrapped(float(np.arctan2(ray[1], ray[0])) - yaw), -self._reach, self._reach)
        # Differences of angles to the base's heading, so that the shorter way never leads over the back.
        gap = np.array(
            [
                aside - wrapped(float(self._angles[0]) - yaw),
                np.arctan2(ray[2], np.hypot(ray[0], ray[1])) - self._angles[1],
            ]
        )
        w = self._frequency
        self._rates += period * (w**2 * gap - 2 * w * self._rates)
        self._rates = np.clip(self._rates, -self._max_rate, self._max_rate)
        self._angles = self._angles + period * self._rates
        azimuth, elevation = self._angles
        flat = np.cos(elevation)
        return np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])


class CameraTour:
    """Drives legs and takes pictures at a steady rate.

    Args:
        episode: the robot in its world.
        shoot: called when a picture is due.
        shots_per_command: pictures for each command of the base, evenly in time.
        config: of the controller; its `period` is the time between two commands.
    """

    def __init__(
        self,
        episode: Episode,
        shoot: Callable[[], object],
        shots_per_command: int = 1,
        config: TrackerConfig | None = None,
    ) -> None:
        self.episode, self.robot, self.shoot = episode, episode.robot, shoot
        self.config = config or TrackerConfig()
        self._shots = shots_per_command
        self._gaze = Gaze(float(self.robot.base_state()[2]))
        self._field = episode.world.field()

    @property
    def fps(self) -> float:
        """Pictures a second."""
        return self._shots / self.config.period

    def settle(self, leg: Leg, duration: float = 2.0) -> None:
        """Let things come to rest [s] and the camera face what a leg looks at, without pictures."""
        for _ in range(round(duration * self.fps)):
            self._advance(leg, (0.0, 0.0))
        self._field = self.episode.world.field()

    def drive(self, leg: Leg) -> None:
        """Drive one leg.

        Raises:
            SystemExit: if there is no free way through its positions.
        """
        path, tracker = self._route(leg), BaseTracker(replace(self.config, cruise_speed=leg.speed))
        start = self.robot.time
        while not tracker.finished:
            if self.robot.time - start > LEG_TIME:
                raise SystemExit(
                    f"{leg} was not driven within {LEG_TIME} s; the base is at {self.robot.base_state()}"
                )
            command = tracker.command(self.robot.base_state(), path, final_yaw=leg.final_yaw)
            self._take(leg, command)
        start = self.robot.time
        while (since := self.robot.time - start) < leg.linger - 1e-9:
            # Ahead and back by 3 cm, and turning by 6 degrees, so that the camera moves as in a fine approach.
            self._take(leg, (0.03 * 1.6 * np.sin(1.6 * since), 0.1 * 1.1 * np.cos(1.1 * since)))

    def _take(self, leg: Leg, command: tuple[float, float]) -> None:
        for _ in range(self._shots):
            self._advance(leg, command)
            self.shoot()

    def _advance(self, leg: Leg, command: tuple[float, float]) -> None:
        period = 1 / self.fps
        eye = self.robot.camera.pose()[:3, 3]
        yaw = float(self.robot.base_state()[2])
        direction = self._gaze.towards(self._target(leg) - eye, yaw, period)
        self.robot.look_at(eye + 3.0 * direction)
        self.robot.drive(*command, period)

    def _target(self, leg: Leg) -> np.ndarray:
        time, (x, y, yaw) = self.robot.time, self.robot.base_state()
        if leg.look_at is None:
            sway = yaw + 0.6 * np.sin(0.8 * time)
            return np.array([x + 1.5 * np.cos(sway), y + 1.5 * np.sin(sway), 0.5])
        centre = self._centre(leg.look_at)
        towards = np.arctan2(centre[1] - y, centre[0] - x)
        aside = leg.wander * np.sin(0.9 * time)
        up = 0.4 * leg.wander * np.sin(0.6 * time)
        offset = np.array([-aside * np.sin(towards), aside * np.cos(towards), up])
        return centre + offset

    def _centre(self, name: str) -> np.ndarray:
        """Middle (3,) of the box about a piece of furniture [m]."""
        parts = [p for p in self._field.primitives if p.name.split(".")[0] == name]
        if not parts:
            raise SystemExit(f"{self.episode.scene.name}: there is nothing called {name!r} to look at")
        corners = np.concatenate([part.mesh().bounds for part in parts])
        return (corners.min(axis=0) + corners.max(axis=0)) / 2

    def _route(self, leg: Leg) -> np.ndarray:
        """Path (n, 2) [m] from here through all positions of a leg."""
        here = torch.as_tensor(self.robot.base_state()[:2], dtype=torch.float32)
        pieces = []
        for position in leg.through:
            goal = torch.tensor(position, dtype=torch.float32)
            route = grid_search(self.episode.body, self._field, here, goal, ROUTE)
            if not route.reaches_goal:
                raise SystemExit(f"{self.episode.scene.name}: no free way from {here.tolist()} to {position}")
            pieces.append(route.path.numpy().astype(float))
            here = goal
        return _rounded(np.concatenate(pieces))


def _rounded(path: np.ndarray, spacing: float = 0.05) -> np.ndarray:
    """The path (n, 2) [m] resampled and with its kinks rounded, its ends kept."""
    arc = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    places = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    dense = np.column_stack([np.interp(places, arc, path[:, i]) for i in (0, 1)])
    # Mirrored at its ends by a point reflection, a straight beginning stays where it is.
    span = min(len(dense) - 1, round(4 * SMOOTHING / spacing))
    before, after = 2 * dense[0] - dense[span:0:-1], 2 * dense[-1] - dense[-2 : -2 - span : -1]
    smooth = gaussian_filter1d(np.concatenate([before, dense, after]), SMOOTHING / spacing, axis=0)
    return smooth[span : span + len(dense)]
