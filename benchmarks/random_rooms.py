"""Randomly furnished rooms, unlike the scenes that anything is measured in: what the completion network learns from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from numba import njit

from robots.simulation import furniture as fn
from robots.simulation.poses import planar_pose
from robots.simulation.primitives import Box, Cylinder, Primitive

KINDS = {"box": 0, "cylinder": 1, "sphere": 2}
CEILINGS = 0.9
"""Share of rooms with a ceiling: few cameras ever see one, but real rooms have it, at much the same height."""
SMALL = 0.5
"""Greatest width of stools, bins and the like [m]."""


@dataclass(frozen=True)
class RandomRoom:
    """A room's solids as arrays: kind, rotation (3, 3) world to body, centre (3,), parameters (3,)."""

    kind: np.ndarray
    rotation: np.ndarray
    centre: np.ndarray
    parameters: np.ndarray
    size: tuple[float, float, float]
    yaw: float
    floor: float
    pieces: np.ndarray
    """(n, 3) middle of the pieces of furniture [m]: what there is to look at."""

    @property
    def solids(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What the compiled functions below take first."""
        return self.kind, self.rotation, self.centre, self.parameters

    def distance(self, points: np.ndarray) -> np.ndarray:
        """True distances (n,) [m] at points (n, 3)."""
        return scene_distance(*self.solids, points)

    def inside(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Which of points (n, 3) lie in the room, or so far [m] inside its walls and its floor."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y = c * points[:, 0] + s * points[:, 1], c * points[:, 1] - s * points[:, 0]
        z = points[:, 2] - self.floor
        return (
            (abs(x) < self.size[0] / 2 + margin)
            & (abs(y) < self.size[1] / 2 + margin)
            & (z > -margin)
            & (z < self.size[2])
        )


def random_room(rng: np.random.Generator) -> RandomRoom:
    """Walls, maybe a ceiling and inner walls with doorways, furniture by the walls and about the room, clutter."""
    height = float(np.clip(rng.normal(2.65, 0.2), 2.3, 3.2))
    size = (float(rng.uniform(2.8, 9)), float(rng.uniform(2.8, 9)), height)
    solids: list[Primitive] = list(fn.room_shell(*size))
    if rng.random() < CEILINGS:
        solids.append(Box("ceiling", planar_pose(0, 0, size[2] + 0.06), (size[0] + 0.3, size[1] + 0.3, 0.12)))
    for axis in range(2):
        if size[axis] > 5 and rng.random() < 0.5:
            solids += inner_wall(rng, size, axis)
    pieces: list[np.ndarray] = []
    for number in range(int(rng.integers(2, 6 + size[0] * size[1] / 3))):
        place(rng, size, solids, pieces, f"piece{number}")
    yaw = 0.0 if rng.random() < 0.6 else float(rng.uniform(-np.pi, np.pi))
    # A random height of the floor, too: lattices of nodes must not learn where it lies between them.
    T = planar_pose(0, 0, rng.uniform(0, 0.16), yaw)
    turned = [solid.at(T @ solid.pose) for solid in solids]
    centres = np.array(pieces).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    return RandomRoom(
        np.array([KINDS[s.kind] for s in turned]),
        np.stack([s.pose[:3, :3].T for s in turned]),
        np.stack([s.pose[:3, 3] for s in turned]),
        np.array([s.parameters for s in turned], dtype=float),
        size,
        yaw,
        float(T[2, 3]),
        centres,
    )


def inner_wall(rng: np.random.Generator, size: tuple[float, float, float], axis: int) -> list[Primitive]:
    """A wall across the room with a doorway, or only a part of one."""
    at, width = rng.uniform(-0.25, 0.25) * size[axis], rng.uniform(0.8, 1.3)
    half, height = size[1 - axis] / 2, size[2]
    door = rng.uniform(-half + 0.2, half - width - 0.2)
    spans = [(-half, door, 0.0), (door + width, half, 0.0)]
    if rng.random() < 0.7:
        spans.append((door, door + width, 2.05))
    out: list[Primitive] = []
    for number, (low, high, bottom) in enumerate(spans):
        where, extent = [0.0, 0.0], [0.1, 0.1]
        where[axis], where[1 - axis] = at, (low + high) / 2
        extent[1 - axis] = high - low
        pose = planar_pose(where[0], where[1], (bottom + height) / 2)
        out.append(Box(f"inner{axis}.{number}", pose, (extent[0], extent[1], height - bottom)))
    return out


def place(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    solids: list[Primitive],
    pieces: list[np.ndarray],
    name: str,
) -> None:
    """Put one piece of furniture where no other stands, if a few tries find room for it."""
    parts, width, depth, top = piece(rng, name)
    for _ in range(8):
        x, y = (rng.uniform(-0.5, 0.5) * (s - depth) for s in size[:2])
        yaw = float(rng.choice([0, 0.5, 1, 1.5]) * np.pi + rng.normal(0, 0.1))
        if rng.random() < 0.65:
            wall = int(rng.integers(4))
            yaw = float([0, np.pi, 0.5 * np.pi, -0.5 * np.pi][wall])
            gap = depth / 2 + rng.uniform(0, 0.08)
            x, y = [
                (x, size[1] / 2 - gap), (x, gap - size[1] / 2), (gap - size[0] / 2, y), (size[0] / 2 - gap, y)
            ][wall]  # fmt: skip
        reach = 0.5 * max(width, depth)
        if all(np.hypot(x - p[0], y - p[1]) > reach + 0.3 for p in pieces):
            solids += fn.placed(parts, x, y, yaw)
            pieces.append(np.array([x, y, 0.7 * top]))
            solids += clutter(rng, name, x, y, yaw, width, depth, top)
            if width > SMALL and any(part.name.endswith(".top") for part in parts) and rng.random() < 0.5:
                solids += chairs(rng, name, x, y, yaw, width, depth)
            return


def chairs(rng, name, x, y, yaw, width, depth) -> list[Primitive]:
    """A few chairs at the sides of a table, more or less drawn out."""
    seats: list[Primitive] = []
    for number, turn in enumerate(np.arange(4) * np.pi / 2):
        if rng.random() < 0.4:
            continue
        out = (depth if number % 2 == 0 else width) / 2 + rng.uniform(-0.2, 0.3)
        aside = rng.uniform(-0.2, 0.2)
        a, b = aside * np.cos(turn) - out * np.sin(turn), aside * np.sin(turn) + out * np.cos(turn)
        seats += fn.placed(fn.chair(f"{name}.chair{number}"), a, b, turn + rng.normal(0, 0.15))
    return list(fn.placed(tuple(seats), x, y, yaw))


def clutter(rng, name, x, y, yaw, width, depth, top) -> list[Primitive]:
    """A few small boxes on top of a piece."""
    if top > 1.2 or rng.random() < 0.4:
        return []
    things: list[Primitive] = []
    for number in range(int(rng.integers(1, 4))):
        extent = rng.uniform(0.05, min(0.35, width, depth), 3)
        a, b = rng.uniform(-0.35, 0.35) * width, rng.uniform(-0.35, 0.35) * depth
        pose = planar_pose(a, b, top + extent[2] / 2, yaw=rng.uniform(0, 3))
        things.append(Box(f"{name}.thing{number}", pose, tuple(extent)))
    return list(fn.placed(tuple(things), x, y, yaw))


def piece(rng: np.random.Generator, name: str) -> tuple[fn.Parts, float, float, float]:
    """A random piece of furniture with its width, depth and height [m]."""
    w, u = float(rng.uniform(0.6, 2.2)), float(rng.uniform(0.35, 1.0))
    h = float(rng.uniform(0.35, 1.1))
    tall = float(rng.uniform(0.8, 2.2))
    kind = int(rng.integers(16))
    if kind <= 2:
        return fn.table(name, w, u, h, thickness=float(rng.uniform(0.02, 0.08))), w, u, h
    if kind == 3:
        return fn.round_table(name, u / 1.5, h), u * 1.3, u * 1.3, h
    if kind == 4:
        return fn.chair(name), 0.45, 0.45, 0.9
    if kind == 5:
        return fn.office_chair(name), 0.5, 0.5, 0.8
    if kind == 6:
        return fn.shelf(name, w, tall, boards=int(rng.integers(3, 7))), w, 0.32, tall
    if kind == 7:
        return fn.sofa(name, max(w, 0.8)), max(w, 0.8), 0.85, 0.85
    if kind == 8:
        return fn.cupboard(name, w, tall, max(0.3, 0.6 * u)), w, max(0.3, 0.6 * u), tall
    if kind == 9:
        return fn.counter(name, max(w, 1.0)), max(w, 1.0), 0.6, 0.9
    if kind == 10:
        return (fn.plant(name), 0.5, 0.5, 1.2) if rng.random() < 0.5 else (fn.floor_lamp(name), 0.3, 0.3, 1.6)
    if kind == 11:
        return fn.bed(name), 1.4, 2.1, 0.5
    if kind >= 13:
        return small_piece(rng, name)
    box = Box(name, planar_pose(0, 0, tall / 2), (w, u, tall))
    return (box,), w, u, tall


def small_piece(rng: np.random.Generator, name: str) -> tuple[fn.Parts, float, float, float]:
    """A stool or side table on legs or a column, or a bin or box, with its width, depth and height [m]."""
    w, u, h = float(rng.uniform(0.2, SMALL)), float(rng.uniform(0.2, SMALL)), float(rng.uniform(0.25, 0.85))
    kind = int(rng.integers(4))
    if kind == 0:
        return fn.table(name, w, u, h, thickness=float(rng.uniform(0.02, 0.1))), w, u, h
    if kind == 1:
        return fn.round_table(name, w / 2, h), w, w, h
    whole: Primitive = Box(name, planar_pose(0, 0, h / 2), (w, u, h))
    if kind == 2:
        whole = Cylinder(name, planar_pose(0, 0, h / 2), w / 2, h)
    return (whole,), w, u, h


@njit(cache=True, nogil=True)
@no_type_check
def solid_distance(kind, p, x, y, z):
    """Signed distance of one solid at a point in its own frame."""
    if kind == 0:
        a, b, c = abs(x) - p[0], abs(y) - p[1], abs(z) - p[2]
        outside = np.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2)
        return outside + min(max(a, b, c), 0.0)
    if kind == 1:
        a, b = np.sqrt(x * x + y * y) - p[0], abs(z) - p[1]
        return np.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2) + min(max(a, b), 0.0)
    return np.sqrt(x * x + y * y + z * z) - p[0]


@njit(cache=True, nogil=True)
@no_type_check
def scene_distance(kinds, rotation, centre, parameters, points):
    """Signed distance (n,) to the union of all solids at points (n, 3)."""
    out = np.full(len(points), 1e9)
    for n in range(len(points)):
        for s in range(len(kinds)):
            d = points[n] - centre[s]
            R = rotation[s]
            x = R[0, 0] * d[0] + R[0, 1] * d[1] + R[0, 2] * d[2]
            y = R[1, 0] * d[0] + R[1, 1] * d[1] + R[1, 2] * d[2]
            z = R[2, 0] * d[0] + R[2, 1] * d[1] + R[2, 2] * d[2]
            out[n] = min(out[n], solid_distance(kinds[s], parameters[s], x, y, z))
    return out


@njit(cache=True, nogil=True)
@no_type_check
def depth_image(kinds, rotation, centre, parameters, T, intrinsics, height, width, near, far):
    """z-depth image (height, width) by casting rays; 0 where nothing lies between near and far [m]."""
    fx, fy, cx, cy = intrinsics
    depth = np.zeros((height, width), dtype=np.float32)
    away = T[:3, 3] - centre
    for v in range(height):
        for u in range(width):
            a, b = (u - cx) / fx, (v - cy) / fy
            ray = T[:3, 0] * a + T[:3, 1] * b + T[:3, 2]
            square = a * a + b * b + 1
            best = far
            for s in range(len(kinds)):
                # Most rays pass a solid's bounding sphere by.
                x, y, z = away[s, 0], away[s, 1], away[s, 2]
                along = ray[0] * x + ray[1] * y + ray[2] * z
                if square * (x * x + y * y + z * z - _radius(kinds[s], parameters[s]) ** 2) > along * along:
                    continue
                R = rotation[s]
                best = min(
                    best,
                    _hit(
                        kinds[s], parameters[s],
                        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
                        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
                        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
                        R[0, 0] * ray[0] + R[0, 1] * ray[1] + R[0, 2] * ray[2],
                        R[1, 0] * ray[0] + R[1, 1] * ray[1] + R[1, 2] * ray[2],
                        R[2, 0] * ray[0] + R[2, 1] * ray[1] + R[2, 2] * ray[2],
                    ),
                )  # fmt: skip
            if near <= best < far:
                depth[v, u] = best
    return depth


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _radius(kind, p):
    """Of the bounding sphere [m]."""
    if kind == 0:
        return np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
    return np.sqrt(p[0] ** 2 + p[1] ** 2) if kind == 1 else p[0]


@njit(cache=True, nogil=True)
@no_type_check
def _hit(kind, p, x, y, z, a, b, c):
    """Where the ray from (x, y, z) along (a, b, c) enters a solid, in its own frame, as a multiple of the ray."""
    enter, leave = 0.0, 1e9
    if kind == 0:
        enter, leave = _slab(x, a, p[0], enter, leave)
        enter, leave = _slab(y, b, p[1], enter, leave)
        enter, leave = _slab(z, c, p[2], enter, leave)
        return enter if enter < leave else 1e9
    square, half, rest = a * a + b * b, a * x + b * y, x * x + y * y - p[0] * p[0]
    if kind == 2:
        square, half, rest = square + c * c, half + c * z, rest + z * z
    else:
        enter, leave = _slab(z, c, p[1], enter, leave)
    root = half * half - square * rest
    if root < 0 or (square < 1e-12 and rest > 0):
        return 1e9
    if square >= 1e-12:
        enter, leave = (
            max(enter, (-half - np.sqrt(root)) / square),
            min(leave, (-half + np.sqrt(root)) / square),
        )
    return enter if enter < leave else 1e9


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _slab(x, a, half, enter, leave):
    """Part of the ray x + t a within |x| < half."""
    if abs(a) < 1e-12:
        return (enter, leave) if abs(x) < half else (1.0, 0.0)
    first, second = (-half - x) / a, (half - x) / a
    return max(enter, min(first, second)), min(leave, max(first, second))
