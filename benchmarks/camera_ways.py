"""Ways of a camera through a random room, as robots and hands move one: what the completion network sees rooms by."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from benchmarks.random_rooms import RandomRoom
from planning.path_reference import wrapped
from robots.simulation.poses import looking

# How often each kind of way is taken: driving about, driving past pieces of furniture, going up to one, by hand,
# turning round at one place.
KINDS = {"drive": 0.2, "visit": 0.35, "reach": 0.2, "hand": 0.1, "turn": 0.15}
# A way of fewer images is given up for another, so many times.
FEWEST, ATTEMPTS = 12, 6
# Time between two images [s]: several of a camera's, for a mapper hardly learns from those between.
PERIOD = 0.3
# Free space about the robot's middle [m], and at which heights [m].
CLEARANCE, HEIGHTS = 0.32, (0.15, 0.5, 0.9, 1.3)
# How far a neck turns to each side [rad].
NECK = 1.25
# Turns that a robot tries when its way is blocked [rad].
TURNS = np.array([0.0, 0.3, -0.3, 0.6, -0.6, 1.0, -1.0, 1.5, -1.5, 2.2, -2.2])

Target = Callable[[float, np.ndarray, float], np.ndarray]


def camera_way(rng: np.random.Generator, room: RandomRoom) -> tuple[str, list[np.ndarray]]:
    """Kind of the way and poses T_world_camera (4, 4); few or none only where the room is too full."""
    kind, poses = "", []
    for _ in range(ATTEMPTS):
        kind = str(rng.choice(list(KINDS), p=list(KINDS.values()))) if len(room.pieces) else "drive"
        poses = _poses(rng, room, kind)
        if len(poses) >= FEWEST:
            break
    return kind, poses


def _poses(rng: np.random.Generator, room: RandomRoom, kind: str) -> list[np.ndarray]:
    if kind == "hand":
        return list(_by_hand(rng, room))
    start = _free_place(rng, room)
    if start is None:
        return []
    if kind == "turn":
        return list(_round(rng, room, start))
    robot = _Robot(room, start, float(rng.uniform(-np.pi, np.pi)), float(rng.normal(1.2, 0.15)))
    {"drive": _drive, "visit": _visit, "reach": _reach}[kind](rng, robot)
    return robot.poses


@dataclass
class _Robot:
    """A camera on a base that turns towards where it goes and round what is in its way.

    Args:
        room: free of it.
        place: (2,) [m].
        heading: [rad].
        height: of the camera [m].
    """

    room: RandomRoom
    place: np.ndarray
    heading: float
    height: float
    time: float = 0.0
    gaze: np.ndarray | None = None
    poses: list[np.ndarray] = field(default_factory=list)

    @property
    def eye(self) -> np.ndarray:
        return np.append(self.place, self.room.floor + self.height)

    def go(self, goal: np.ndarray, speed: float, target: Target, most: int = 80) -> None:
        """Towards a place (2,) [m] at a speed [m/s], for no more than so many images."""
        for _ in range(most):
            gap = goal - self.place
            if np.linalg.norm(gap) < 0.25:
                return
            turn = np.clip(wrapped(float(np.arctan2(gap[1], gap[0])) - self.heading), -0.5, 0.5)
            ways = self.heading + turn + TURNS
            steps = self.place + speed * PERIOD * np.stack([np.cos(ways), np.sin(ways)], axis=1)
            free = _is_free(self.room, steps)
            if free.any():
                first = int(free.argmax())
                # What turns far stands still meanwhile.
                self.heading, self.place = float(ways[first]), steps[first] if first < 7 else self.place
            else:
                self.heading += 0.5
            self.shoot(target)

    def stay(self, seconds: float, target: Target, towards: np.ndarray) -> None:
        """Turn towards a place (2,) [m] and shift to and fro as when lining up a grasp."""
        for _ in range(int(seconds / PERIOD)):
            gap = towards - self.place
            turn = wrapped(float(np.arctan2(gap[1], gap[0])) - self.heading)
            self.heading += float(np.clip(turn, -0.4, 0.4)) + 0.05 * np.cos(1.1 * self.time)
            ahead = 0.015 * np.sin(1.6 * self.time)
            self.place = self.place + ahead * np.array([np.cos(self.heading), np.sin(self.heading)])
            self.shoot(target)

    def shoot(self, target: Target) -> None:
        """An image with the gaze, not as fast as wished, towards a target."""
        ray = target(self.time, self.place, self.heading) - self.eye
        aside = np.clip(wrapped(float(np.arctan2(ray[1], ray[0])) - self.heading), -NECK, NECK)
        wish = np.array([self.heading + aside, np.arctan2(ray[2], np.hypot(ray[0], ray[1]))])
        if self.gaze is not None:
            change = np.array([wrapped(float(wish[0] - self.gaze[0])), wish[1] - self.gaze[1]])
            wish = self.gaze + np.clip(0.7 * change, -1.2 * PERIOD, 1.2 * PERIOD)
        self.gaze = wish
        azimuth, elevation = wish
        direction = [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
        self.poses.append(looking(self.eye, direction))
        self.time += PERIOD


def _drive(rng: np.random.Generator, robot: _Robot) -> None:
    sway, low = rng.uniform(0, 0.9), rng.uniform(0.2, 0.9)

    def ahead(time: float, place: np.ndarray, heading: float) -> np.ndarray:
        angle = heading + sway * np.sin(0.8 * time)
        return np.array([*(place + 1.5 * np.array([np.cos(angle), np.sin(angle)])), low])

    for _ in range(int(rng.integers(2, 6))):
        goal = _free_place(rng, robot.room)
        if goal is not None:
            robot.go(goal, rng.uniform(0.4, 0.65), ahead)


def _visit(rng: np.random.Generator, robot: _Robot) -> None:
    for _ in range(int(rng.integers(1, 4))):
        piece = robot.room.pieces[rng.integers(len(robot.room.pieces))]
        target = _wandering(piece, rng.uniform(0.2, 0.5))
        for _ in range(int(rng.integers(1, 4))):
            goal = _free_place(rng, robot.room, piece[:2], rng.uniform(0.7, 2.2))
            if goal is not None:
                robot.go(goal, rng.uniform(0.3, 0.5), target)


def _reach(rng: np.random.Generator, robot: _Robot) -> None:
    piece = robot.room.pieces[rng.integers(len(robot.room.pieces))] + rng.normal(0, 0.15, 3)
    target = _wandering(piece, rng.uniform(0.1, 0.4))
    goal = _free_place(rng, robot.room, piece[:2], rng.uniform(0.5, 1.0))
    if goal is not None:
        # Robots begin to reach from anywhere, also from close by.
        robot.stay(0.4, target, goal)
        robot.go(goal, rng.uniform(0.2, 0.45), target)
        robot.stay(rng.uniform(1, 7), target, piece[:2])


def _wandering(centre: np.ndarray, wander: float) -> Target:
    """A gaze that wanders so far [m] about a centre (3,)."""

    def target(time: float, place: np.ndarray, heading: float) -> np.ndarray:
        towards = np.arctan2(centre[1] - place[1], centre[0] - place[0])
        aside, up = wander * np.sin(0.9 * time), 0.4 * wander * np.sin(0.6 * time)
        return centre + np.array([-aside * np.sin(towards), aside * np.cos(towards), up])

    return target


def _by_hand(rng: np.random.Generator, room: RandomRoom) -> Iterator[np.ndarray]:
    """Round a piece of furniture, or looking hither and thither from one place."""
    target = room.pieces[rng.integers(len(room.pieces))] + rng.normal(0, 0.1, 3)
    angle, count = rng.uniform(0, 2 * np.pi), int(rng.integers(16, 60))
    radius, rise, sweep = rng.uniform(0.5, 2.5), rng.uniform(0.1, 0.9), rng.uniform(0.4, 6.3)
    still = rng.random() < 0.4
    for n in range(count):
        a = angle + (0 if still else sweep * n / count)
        eye = target + np.array([radius * np.cos(a), radius * np.sin(a), rise])
        at = target
        if still:
            eye, at = eye + rng.normal(0, 0.1, 3), target + rng.normal(0, 0.45, 3) * np.array([1, 1, 0.4])
        if room.inside(eye[None])[0] and room.distance(eye[None])[0] > 0.1:
            yield looking(eye, at - eye)


def _round(rng: np.random.Generator, room: RandomRoom, place: np.ndarray) -> Iterator[np.ndarray]:
    """Turning about a place (2,) [m], held a little out of the axis: as one looks round where one begins."""
    angle, sweep, count = rng.uniform(0, 2 * np.pi), rng.uniform(1.5, 7), int(rng.integers(FEWEST, 40))
    arm, height, rise = rng.uniform(0, 0.4), rng.uniform(0.5, 1.6), -rng.uniform(-0.1, 0.7)
    for a in angle + sweep * np.arange(count) / count:
        ahead = np.array([np.cos(a), np.sin(a)])
        eye = np.append(place + arm * ahead, room.floor + height)
        if room.inside(eye[None])[0] and room.distance(eye[None])[0] > 0.1:
            yield looking(eye, [*ahead, rise])


def _free_place(
    rng: np.random.Generator, room: RandomRoom, about: np.ndarray | None = None, away: float = 0.0
) -> np.ndarray | None:
    """A place (2,) [m] where a robot can stand, anywhere or about so far from another; None where none was found."""
    if about is None:
        places = rng.uniform(-0.5, 0.5, (40, 2)) * np.hypot(*room.size[:2])
    else:
        angle, reach = rng.uniform(0, 2 * np.pi, 40), away * rng.uniform(0.9, 1.3, 40)
        places = about + np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    free = _is_free(room, places)
    return places[free.argmax()] if free.any() else None


def _is_free(room: RandomRoom, places: np.ndarray) -> np.ndarray:
    """Whether a robot can stand at places (n, 2) [m]."""
    free = np.ones(len(places), dtype=bool)
    for height in HEIGHTS:
        points = np.column_stack([places, np.full(len(places), room.floor + height)])
        distance = room.distance(points)
        free &= room.inside(points) & (distance > min(CLEARANCE, height - 0.02))
    return free
