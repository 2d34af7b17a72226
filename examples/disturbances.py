"""What disturbs an episode: a shaking camera pose, people who walk about, furniture that is moved, a failing sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from robots.simulation import Cylinder, DepthFrame, SimulatedMobileRobot
from robots.simulation.poses import planar_pose

Planar = Float[ndarray, "2"]


class Disturbance(Protocol):
    """Changes what is seen, or the world as time goes on."""

    def frame(self, frame: DepthFrame | None) -> DepthFrame | None:
        """The image as the robot gets it."""
        ...

    def advance(self, robot: SimulatedMobileRobot, duration: float) -> None:
        """Let the world change during the next `duration` [s]."""
        ...


class DisturbedRobot:
    """A simulated robot whose world is not as quiet as the simulator's; a `planning.drive.MobileRobot`.

    Args:
        robot: what is disturbed.
        disturbances: applied in turn.
    """

    def __init__(self, robot: SimulatedMobileRobot, disturbances: Sequence[Disturbance]) -> None:
        self._undisturbed, self.disturbances = robot, list(disturbances)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._undisturbed, name)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._undisturbed.time

    def base_state(self) -> Float[ndarray, "3"]:
        """x, y [m] and yaw [rad] of the base."""
        return self._undisturbed.base_state()

    def look_at(self, point: Float[ndarray, "3"]) -> None:
        """Turn the head towards a point [m]."""
        self._undisturbed.look_at(point)

    def observe(self) -> DepthFrame | None:
        """The newest image, disturbed; None if the sensor gives none."""
        frame: DepthFrame | None = self._undisturbed.observe()
        for disturbance in self.disturbances:
            frame = disturbance.frame(frame)
        return frame

    def drive(self, v: float, omega: float, duration: float) -> None:
        """Drive for some time [s] while the world changes."""
        for disturbance in self.disturbances:
            disturbance.advance(self._undisturbed, duration)
        self._undisturbed.drive(v, omega, duration)

    def wait(self, duration: float, period: float = 0.1) -> None:
        """Let time [s] pass at rest, while the world changes."""
        for _ in range(max(1, round(duration / period))):
            self.drive(0.0, 0.0, period)


@dataclass
class PoseNoise:
    """The camera pose is off by another draw in every image.

    Args:
        seed: of the draws.
        position: standard deviation along each axis [m].
        angle: standard deviation about each axis [rad].
    """

    seed: int
    position: float = 0.01
    angle: float = float(np.radians(0.5))

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng([self.seed, 31])

    def frame(self, frame: DepthFrame | None) -> DepthFrame | None:
        """The same image with a pose that is a little wrong."""
        if frame is None:
            return None
        T = frame.T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ _rotation(self._rng.normal(0, self.angle, 3))
        T[:3, 3] += self._rng.normal(0, self.position, 3)
        return replace(frame, T_world_camera=T)

    def advance(self, robot: SimulatedMobileRobot, duration: float) -> None:
        """Nothing in the world changes."""


@dataclass
class SensorFault:
    """The depth camera fails for a while.

    Args:
        kind: "silent" gives no image, "invalid" images without a measurement, "jump" a pose 30 cm beside the true one.
        begin: [s].
        end: [s].
    """

    kind: str
    begin: float
    end: float

    def frame(self, frame: DepthFrame | None) -> DepthFrame | None:
        """What is left of the image."""
        if frame is None or not self.begin <= frame.time < self.end:
            return frame
        if self.kind == "silent":
            return None
        if self.kind == "invalid":
            return replace(frame, depth=np.zeros_like(frame.depth))
        T = frame.T_world_camera.copy()
        T[:2, 3] += 0.3 * np.array([0.6, 0.8])
        return replace(frame, T_world_camera=T)

    def advance(self, robot: SimulatedMobileRobot, duration: float) -> None:
        """Nothing in the world changes."""


PATIENCE = 1.5
"""People wait about this long for a robot, or for each other, in their way [s]."""


class People:
    """Cylinders as large as people walk by the shortest ways from one place to another.

    Like people they do not walk into what stands in their way: they wait while the robot is closer than `courtesy`, and
    after a while go elsewhere.

    Args:
        free: (n, 2) places [m] with room for a person, a grid.
        spacing: of that grid [m].
        seed: of their ways.
        count: how many.
        speed: [m/s].
        courtesy: gap [m] between the robot's axis and a person's surface at which they wait.
    """

    RADIUS, HEIGHT = 0.22, 1.7

    def __init__(
        self, free: Float[ndarray, "n 2"], spacing: float, seed: int, count: int = 3, speed: float = 0.5,
        courtesy: float = 0.75,
    ) -> None:  # fmt: skip
        self._free, self.speed, self.courtesy = free, speed, courtesy
        self._tree = cKDTree(free)
        self._graph = self._tree.sparse_distance_matrix(self._tree, 1.5 * spacing).tocsr()
        self._rng = np.random.default_rng([seed, 47])
        self.names = tuple(f"person_{i}" for i in range(count))
        self._places: list[Planar] = []
        self._ways = [np.empty((0, 2))] * count

    def frame(self, frame: DepthFrame | None) -> DepthFrame | None:
        """People are seen like everything else."""
        return frame

    def advance(self, robot: SimulatedMobileRobot, duration: float) -> None:
        """Walk on, each to where he wants to go next."""
        here = robot.base_state()[:2]
        if not self._places:
            self._enter(robot, here)
        for i, name in enumerate(self.names):
            self._places[i] = self._walked(i, here, duration)
            robot.world.set_object_pose(name, planar_pose(*self._places[i], self.HEIGHT / 2))

    def _enter(self, robot: SimulatedMobileRobot, here: Planar) -> None:
        for name in self.names:
            apart = np.linalg.norm(self._free[:, None] - np.array([here, *self._places]), axis=2).min(axis=1)
            far = np.flatnonzero(apart > min(2.0, 0.8 * apart.max()))
            place = self._free[self._rng.choice(far)]
            self._places.append(place)
            pose = planar_pose(*place, self.HEIGHT / 2)
            robot.world.add_body(Cylinder(name, pose, self.RADIUS, self.HEIGHT, colour=(0.8, 0.5, 0.3)))

    def _walked(self, i: int, robot: Planar, duration: float) -> Planar:
        """Where a person is after some time [s]."""
        place = self._places[i]
        if len(self._ways[i]) == 0:
            self._ways[i] = self._way_elsewhere(place, robot)
        there, way = _along(place, self._ways[i], self.speed * duration)
        if self._may_walk(i, there, robot):
            self._ways[i] = way
            return there
        if self._rng.random() < duration / PATIENCE:
            self._ways[i] = self._way_elsewhere(place, robot)
        return place

    def _way_elsewhere(self, place: Planar, robot: Planar) -> Float[ndarray, "k 2"]:
        """The shortest way to any other place [m] that does not lead past the robot."""
        start = int(self._tree.query(place)[1])
        away = np.linalg.norm(self._free - robot, axis=1)
        open_ = away >= min(self.RADIUS + self.courtesy, away[start])
        free, here = self._free[open_], int(open_[:start].sum())
        far, before = dijkstra(self._graph[open_][:, open_], indices=here, return_predecessors=True)
        way = [int(self._rng.choice(np.flatnonzero(np.isfinite(far))))]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return free[way[::-1]][1:]

    def _may_walk(self, i: int, there: Planar, robot: Planar) -> bool:
        """Whether a step brings a person too near neither to the robot nor to others; away from them it may lead."""
        gaps = [(robot, self.RADIUS + self.courtesy)]
        gaps += [(place, 3 * self.RADIUS) for j, place in enumerate(self._places) if j != i]
        return all(
            np.linalg.norm(there - other) >= min(gap, float(np.linalg.norm(self._places[i] - other)))
            for other, gap in gaps
        )


def _along(place: Planar, way: Float[ndarray, "k 2"], length: float) -> tuple[Planar, Float[ndarray, "m 2"]]:
    """A place that is `length` [m] farther along a way, and the rest of the way."""
    for n, corner in enumerate(way):
        step = corner - place
        far = float(np.linalg.norm(step))
        if far > length:
            return place + length / far * step, way[n:]
        place, length = corner, length - far
    return place, way[:0]


class MovedFurniture:
    """Somebody moves a piece of furniture while the robot is on its way.

    Args:
        name: of a solid.
        to: where its middle is to be, x and y [m].
        when: called with the robot; says when it is time.
    """

    def __init__(self, name: str, to: Planar, when: Callable[[SimulatedMobileRobot], bool]) -> None:
        self.name, self.to, self.when = name, to, when
        self.moved_at: float | None = None

    def frame(self, frame: DepthFrame | None) -> DepthFrame | None:
        """Seen like everything else."""
        return frame

    def advance(self, robot: SimulatedMobileRobot, duration: float) -> None:
        """Move it once, when it is time."""
        if self.moved_at is None and self.when(robot):
            pose = robot.world.object_pose(self.name)
            pose[:2, 3] = self.to
            robot.world.set_object_pose(self.name, pose)
            self.moved_at = robot.time


def _rotation(vector: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """Rotation matrix of a rotation vector [rad]."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
