"""The last guard before the motors: it stops the base when the last depth images show that contact is imminent.

It knows neither map nor planner, so that no mistake of theirs can mislead it; navigation stacks keep such a monitor
apart for the same reason. What the camera has turned away from it remembers for a while.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial import cKDTree

from planning.errors import ConfigError
from planning.numbers import refuse_nan
from planning.recent_points import RecentPoints

logger = logging.getLogger(__name__)

Spheres = tuple[Float[ndarray, "s 3"], Float[ndarray, " s"]]

# Parts of the command that are tried, the fastest first.
SHARES = (1.0, 0.7, 0.45, 0.25)
# Places along the way to standstill that are tested lie at most this far apart, for any point of the robot [m].
STEP = 0.02
# Less clear by no more than this [m] than now is as clear: measured surfaces are rough.
SHAKE = 0.004


@runtime_checkable
class DepthImage(Protocol):
    """A posed depth image without the robot's own body."""

    @property
    def time(self) -> float:
        """When it was taken [s]."""
        ...

    def points(self) -> Float[ndarray, "n 3"]:
        """The measured points [m, world frame]."""
        ...

    def sees(self, points: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Which places [m] it shows: nothing was measured nearer in their direction."""
        ...


@dataclass(frozen=True)
class CollisionMonitorConfig:
    """When the monitor steps in.

    Args:
        margin: gap [m] that the braking robot must keep to every point of the newest image.
        reaction: time [s] until the brakes answer, during which the base goes on as commanded.
        braking: deceleration [m/s^2] of the base; turning brakes three times as fast, in rad/s^2.
        memory: points that are out of view since count for this long [s].
        max_age: older images [s] tell nothing about the way ahead: the base stops until there is a new one.
        least_points: an image with fewer measured points is taken for no image.
        agreeing: measured points that must agree before they count as an obstacle; lone ones are noise.
        floor: points lower than this [m] are the floor.
        reach: points farther from the base than this [m] are left out.
    """

    margin: float = 0.02
    reaction: float = 0.2
    braking: float = 0.6
    memory: float = 2.0
    max_age: float = 0.6
    least_points: int = 100
    agreeing: int = 4
    floor: float = 0.06
    reach: float = 2.0

    def __post_init__(self) -> None:
        refuse_nan(self)
        positive = (self.braking, self.max_age, self.reach)
        if not (
            min(positive) > 0
            and min(self.margin, self.reaction, self.memory, self.floor) >= 0
            and self.agreeing >= 1
        ):
            raise ConfigError(
                "CollisionMonitorConfig: braking, max_age and reach must be positive, margin, reaction, memory and "
                f"floor not negative and agreeing at least 1, got {self}."
            )


@dataclass
class Interventions:
    """How often [control periods] the monitor changed a command, and why it last did."""

    slowed: int = 0
    stopped: int = 0
    blind: int = 0
    reason: str = ""


class _Obstacle(NamedTuple):
    """Measured points, how many of them must agree, and how much nearer [m] than `margin` they may be."""

    tree: cKDTree
    agreeing: int
    allowance: float


class CollisionMonitor:
    """Lets a command of the base pass, slows it or stops it.

    A command passes if the robot, held to it for the reaction time and then braking along the same arc, stays clear
    of every point of the newest image, and of what the last ones showed where it does not look. Where it is too near
    already, it may move as long as it does not come nearer.

    Args:
        body: the robot's spheres now: centres (s, 3) [m, world] and radii (s,) [m].
        config: see `CollisionMonitorConfig`.
    """

    def __init__(self, body: Callable[[], Spheres], config: CollisionMonitorConfig | None = None) -> None:
        self.body, self.config = body, config or CollisionMonitorConfig()
        self.interventions = Interventions()
        self._image: DepthImage | None = None
        self._points: Float[ndarray, "n 3"] = np.empty((0, 3))
        self._recent = RecentPoints(self.config.memory, self.config.agreeing)
        self._state = "clear"

    @property
    def slowing(self) -> bool:
        """Whether the last command was changed."""
        return self._state != "clear"

    def see(self, image: DepthImage | None) -> None:
        """Take the newest image in the place of the last; None and images that show next to nothing change nothing."""
        if image is None:
            return
        points = np.asarray(image.points())
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) < self.config.least_points:
            return
        self._image, self._points = image, points[points[:, 2] > self.config.floor]
        self._recent.add(image, self._points)

    def limit(self, state: Float[ndarray, " 3"], v: float, omega: float, now: float) -> tuple[float, float]:
        """The command to send instead of (v [m/s], omega [rad/s]).

        Args:
            state: x, y [m] and yaw [rad] of the base.
            v: speed that the controller wants.
            omega: turning rate that it wants.
            now: the time [s].
        """
        if v == 0 and omega == 0:
            return v, omega
        if self._image is None or now - self._image.time > self.config.max_age:
            self.interventions.blind += 1
            self._note("blind", "no depth image for the last moments")
            return 0.0, 0.0
        share = self._passable(state, v, omega)
        if share == 1:
            self._note("clear", "")
        elif share > 0:
            self.interventions.slowed += 1
            self._note("slowed", "something is close ahead")
        else:
            self.interventions.stopped += 1
            self._note("stopped", "contact was imminent")
        return share * v, share * omega

    def _passable(self, state: Float[ndarray, " 3"], v: float, omega: float) -> float:
        """The greatest of `SHARES` with which the base still stops in time; 0 if none."""
        obstacles = self._obstacles(state)
        if not obstacles:
            return 1.0
        centres, radii = self.body()
        now = float(self._clearance(obstacles, centres[None], radii)[0])
        # Where it is too near already it may scrape along for a moment, but must end no nearer: else it would creep.
        on_the_way, at_the_end = min(self.config.margin, now - SHAKE), min(self.config.margin, now)
        for share in SHARES:
            poses = self._way_to_standstill(share * v, share * omega)
            clearance = self._clearance(obstacles, moved(centres, state, poses), radii)
            if (clearance >= on_the_way).all() and clearance[-1] >= at_the_end:
                return share
        return 0.0

    def _obstacles(self, state: Float[ndarray, " 3"]) -> list[_Obstacle]:
        """Points within reach of the base."""
        config, out = self.config, []
        for points, agreeing, margin in (
            (self._points, config.agreeing, config.margin),
            # Narrow places are driven through with things close on both sides: what is out of view gets no margin.
            (self._recent.points, 1, 0.0),
        ):
            near = points[np.linalg.norm(points[:, :2] - state[:2], axis=1) <= config.reach]
            if len(near) >= agreeing:
                out.append(_Obstacle(cKDTree(near), agreeing, config.margin - margin))
        return out

    def _way_to_standstill(self, v: float, omega: float) -> Float[ndarray, "k 3"]:
        """Places relative to the base now, (x, y, yaw), that it passes while it reacts and brakes."""
        reaction, braking = self.config.reaction, self.config.braking
        # Forward speed and turning stop together, so the arc is that of the command.
        time = reaction + max(abs(v) / braking, abs(omega) / (3 * braking)) / 2
        outermost = 0.5  # [m] from the axis of the base
        count = max(2, math.ceil(time * (abs(v) + outermost * abs(omega)) / STEP))
        along = time * np.linspace(0, 1, count + 1)[1:]
        yaw = omega * along
        if abs(omega) < 1e-6:
            return np.stack([v * along, np.zeros_like(along), yaw], axis=1)
        return np.stack([v / omega * np.sin(yaw), v / omega * (1 - np.cos(yaw)), yaw], axis=1)

    def _clearance(
        self, obstacles: list[_Obstacle], centres: Float[ndarray, "k s 3"], radii: Float[ndarray, " s"]
    ) -> Float[ndarray, " k"]:
        """Least gap [m] to as many points as must agree, of every place."""
        bound = float(radii.max()) + self.config.margin + 0.3
        least = np.full(len(centres), bound)
        for tree, agreeing, allowance in obstacles:
            distance, _ = tree.query(centres, k=[agreeing], distance_upper_bound=bound)
            least = np.minimum(least, (distance[..., 0] - radii).min(axis=1) + allowance)
        return least

    def _note(self, state: str, reason: str) -> None:
        if state != self._state and state != "clear":
            logger.info("collision monitor: %s, %s", state, reason)
        self._state = state
        self.interventions.reason = reason or self.interventions.reason


def moved(
    centres: Float[ndarray, "s 3"], state: Float[ndarray, " 3"], poses: Float[ndarray, "k 3"]
) -> Float[ndarray, "k s 3"]:
    """Sphere centres [m] after the base at `state` has moved by planar poses in its own frame."""
    cos, sin = math.cos(state[2]), math.sin(state[2])
    local = (centres[:, :2] - state[:2]) @ np.array([[cos, -sin], [sin, cos]])
    turn = np.stack(
        [np.cos(poses[:, 2]), -np.sin(poses[:, 2]), np.sin(poses[:, 2]), np.cos(poses[:, 2])], axis=1
    )
    planar = np.einsum("kij,sj->ksi", turn.reshape(-1, 2, 2), local) + poses[:, None, :2]
    world = planar @ np.array([[cos, sin], [-sin, cos]]) + state[:2]
    heights = np.broadcast_to(centres[:, 2], planar.shape[:2])
    return np.concatenate([world, heights[..., None]], axis=2)
