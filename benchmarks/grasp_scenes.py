"""Scenes to grasp in: a furnished room where a thing stands on a table, a counter or a shelf, others beside it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from robots.simulation import Box, Cylinder, GraspTask, Primitive, Scene, Sphere, load_object, make_scene
from robots.simulation import furniture as fn
from robots.simulation.poses import planar_pose
from robots.simulation.rooms import PARK_DISTANCE, can, small_box

Support = Literal["table", "counter", "shelf"]
SUPPORTS: tuple[Support, ...] = ("table", "counter", "shelf")
ROOMS = ("apartment", "office", "flat")
BEHIND_EDGE = 0.1
"""The thing stands so far behind the front edge of its support [m]."""
BESIDE = 0.3
"""Others stand so far to its left and right [m]."""


def _pieces() -> dict[Support, tuple[Callable[[], fn.Parts], float, float]]:
    """Of each support how to build it, its depth and the height that things stand at [m]."""
    return {
        "table": (lambda: fn.table("support", 1.0, 0.6, 0.7), 0.6, 0.7),
        "counter": (lambda: fn.counter("support", 1.0), 0.6, 0.9),
        "shelf": (lambda: fn.shelf("support", 1.0, 1.3, boards=3), 0.32, 0.6925),
    }


def shapes() -> dict[str, Primitive]:
    """Things of our own, for those who have no others."""
    eye, soft = np.eye(4), {"mass": 0.15, "friction": 0.9}
    return {
        "box": small_box("box"),
        "can": can("can"),
        "carton": Box("carton", eye, (0.06, 0.06, 0.2), mass=0.4, friction=0.9),
        "bar": Box("bar", eye, (0.16, 0.035, 0.035), **soft),
        "brick": Box("brick", eye, (0.1, 0.06, 0.05), **soft),
        "ball": Sphere("ball", eye, 0.03, **soft),
        "jar": Cylinder("jar", eye, 0.033, 0.09, mass=0.3, friction=0.9),
        "tube": Cylinder("tube", eye, 0.025, 0.2, **soft),
    }


def things(folder: Path | None) -> list[str]:
    """Names of our own shapes, or the paths of all URDF objects in a folder; refuses a folder without any."""
    if folder is None:
        return list(shapes())
    found = sorted({path.parent for path in folder.glob("*/*.urdf")})
    if not found:
        raise SystemExit(f"{folder}: no object in it; expected folders with a .urdf file each")
    return [str(path.resolve()) for path in found]


def thing_named(name: str) -> Primitive:
    """One of `things`, at the origin."""
    own = shapes()
    return own[name] if name in own else load_object(name)


def grasp_scene(room: str, seed: int, support: Support, thing: Primitive) -> Scene:
    """A furnished room with a thing to grasp on a support, and a can and a box beside it.

    Args:
        room: one with a grasp task of its own.
        seed: of the room and how the thing is turned.
        support: what the thing stands on, in the place of the room's own table.
        thing: what to grasp; it stands as its own frame does.
    """
    rng, scene = np.random.default_rng([seed, 11]), make_scene(room, seed)
    task = scene.grasp
    if task is None:
        raise SystemExit(f"{room} has no grasp task; choose one of {', '.join(ROOMS)}")
    build, depth, height = _pieces()[support]
    x, y, heading = task.park
    ahead = PARK_DISTANCE + depth / 2
    piece = planar_pose(
        x + ahead * math.cos(heading), y + ahead * math.sin(heading), yaw=heading - math.pi / 2
    )
    spares = [s for s in scene.objects if s.name.startswith("spare")]
    others = [s for s in scene.objects if s.name != task.object_name and s not in spares]
    kept = [s for s in scene.static if not s.name.startswith(f"{task.table_name}.")]
    target = replace(thing, name="target")
    placed = [(target, 0.0), (small_box("left"), -BESIDE), (can("right"), BESIDE)]
    front = -depth / 2 + BEHIND_EDGE
    stood = [_stood(t, piece, at, front, height, rng) for t, at in placed]
    return replace(
        scene,
        static=(*kept, *fn.placed(build(), piece[0, 3], piece[1, 3], heading - math.pi / 2)),
        objects=(*others, *stood),
        grasp=GraspTask("target", "support", task.park),
    )


def _stood(
    thing: Primitive, piece: np.ndarray, x: float, y: float, height: float, rng: np.random.Generator
) -> Primitive:
    """A thing that stands on a piece, turned any way; a millimetre above, to settle."""
    lowest = float(thing.local_mesh().bounds[0, 2])
    yaw = 0.0 if isinstance(thing, Cylinder | Sphere) else float(rng.uniform(-math.pi, math.pi))
    return thing.at(piece @ planar_pose(x, y, height - lowest + 0.001, yaw))
