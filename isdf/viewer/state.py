"""What is shown at one moment: a map, an image, and whatever the program that maps wants drawn with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Spheres:
    """Balls of one colour.

    Args:
        centres: (n, 3) [m].
        radii: (n,) [m].
        colour: red, green, blue in 0 .. 255.
        opacity: in (0, 1].
    """

    centres: Float[np.ndarray, "n 3"]
    radii: Float[np.ndarray, "n"]
    colour: Colour = (240, 150, 40)
    opacity: float = 0.35


@dataclass(frozen=True)
class Line:
    """A polyline.

    Args:
        points: (n, 3) [m]; nothing is drawn of fewer than two.
        colour: red, green, blue in 0 .. 255.
        width: [m].
    """

    points: Float[np.ndarray, "n 3"]
    colour: Colour = (40, 170, 60)
    width: float = 0.03


@dataclass(frozen=True, eq=False)
class Shape:
    """A triangle mesh. It is sent and recorded once: the same object in the next state is the same mesh.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        colour: red, green, blue in 0 .. 255.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Integer[np.ndarray, "m 3"]
    colour: Colour = (200, 205, 210)


@dataclass(frozen=True)
class ViewState:
    """One moment. Nothing in it may change afterwards: another thread draws it.

    Layers are shown and hidden by their names; what follows a slash in a name only tells parts of a layer apart.

    Args:
        time: of the robot or of the sequence [s].
        status: a line or two of Markdown.
        frame: the newest `DepthFrame`, or anything with its attributes.
        field: a distance field with `bounds`; the same object as before means an unchanged map.
        shapes: meshes by name.
        poses: T_world_shape (4, 4) of the shapes that are not in world coordinates.
        spheres: by name.
        lines: by name.
        goal: x, y on the floor or x, y, z [m]; it can be dragged there.
    """

    time: float = 0.0
    status: str = ""
    frame: Any = None
    field: Any = None
    shapes: Mapping[str, Shape] = dataclasses.field(default_factory=dict)
    poses: Mapping[str, Float[np.ndarray, "4 4"]] = dataclasses.field(default_factory=dict)
    spheres: Mapping[str, Spheres] = dataclasses.field(default_factory=dict)
    lines: Mapping[str, Line] = dataclasses.field(default_factory=dict)
    goal: Float[np.ndarray, "d"] | None = None


Compose = Callable[[], ViewState]
"""Makes a state, in the thread that draws: who shows something pays for no more than this closure."""


def layer_of(name: str) -> str:
    """The layer that a named thing belongs to."""
    return name.partition("/")[0]
