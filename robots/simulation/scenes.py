"""Scenes: the rooms a robot is simulated in, with a start, goals and something to grasp."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robots.errors import SceneError
from robots.simulation.free_space import FloorMap, floor_map
from robots.simulation.furniture import room_shell
from robots.simulation.homes import HOMES
from robots.simulation.primitives import Primitive
from robots.simulation.rooms import ROOMS, GraspTask, Layout

PlanarPose = tuple[float, float, float]

BASE_RADIUS = 0.5
"""A disc of this radius [m] fits at the start and the goals and on a way between them."""
TRAVEL = 3.5
"""Least straight distance between start and goal [m]."""
ATTEMPTS = 20
FURNISHED = {**ROOMS, **HOMES}


@dataclass(frozen=True, eq=False)
class Scene:
    """A room as the simulator, the camera and the ground-truth field see it.

    Attributes:
        name: what the scene is called.
        static: solids that never move by themselves; the floor is named "floor".
        objects: solids with a mass, free to move.
        size: free width, depth and height [m] of the room, centred on the world origin at floor level; None
            for a scene read from a file.
        start: base pose (x, y, yaw) [m, rad] with room for a disc of `BASE_RADIUS`; None if not known.
        goals: base poses reachable from the start by that disc and at least `TRAVEL` away; the first is the
            scene's own goal, the others are alternatives.
        grasp: the object to pick up, if any.
        urdf_path: a static URDF that is part of the scene; its surfaces are seen and collided with but are
            not in the ground-truth field.
    """

    name: str
    static: tuple[Primitive, ...] = ()
    objects: tuple[Primitive, ...] = ()
    size: tuple[float, float, float] | None = None
    start: PlanarPose | None = None
    goals: tuple[PlanarPose, ...] = ()
    grasp: GraspTask | None = None
    urdf_path: Path | None = None

    def __post_init__(self) -> None:
        names = [p.name for p in (*self.static, *self.objects)]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise SceneError(f"scene {self.name!r}: names must be unique, got {twice} more than once")
        wrong = [p.name for p in self.static if p.mass > 0] + [p.name for p in self.objects if p.mass == 0]
        if wrong:
            raise SceneError(
                f"scene {self.name!r}: static solids need mass 0 and objects a positive mass; check {wrong}"
            )

    @property
    def goal(self) -> PlanarPose | None:
        """The first of the goals; None if there is none."""
        return self.goals[0] if self.goals else None


def available_scenes() -> tuple[str, ...]:
    """Names that `make_scene` knows."""
    return tuple(FURNISHED)


def make_scene(name: str, seed: int = 0) -> Scene:
    """Furnish a room: the seed shifts and turns the furniture and picks start, goals and the grasp object.

    The same name and seed always give the same scene.

    Raises:
        SceneError: if there is no scene of that name.
    """
    if name not in FURNISHED:
        raise SceneError(f"no scene named {name!r}; choose one of {', '.join(available_scenes())}")
    size, furnish = FURNISHED[name]
    rng = np.random.default_rng([seed, *name.encode()])
    for _ in range(ATTEMPTS):
        layout = Layout(size, rng, static=list(room_shell(*size)))
        furnish(layout)
        solids = (*layout.static, *layout.objects)
        poses = _start_and_goals(floor_map(solids, *size[:2]), rng)
        if poses is not None:
            start, goals = poses
            return Scene(name, tuple(layout.static), tuple(layout.objects), size, start, goals, layout.grasp)
    raise SceneError(f"{name!r} with seed {seed}: no start and goal {TRAVEL} m apart; try another seed")


def load_urdf_scene(path: str | Path) -> Scene:
    """Make a scene of a static URDF, such as a house of meshes.

    A collision mesh in it is taken as its convex hull unless marked `<collision concave="yes">`.

    Raises:
        SceneError: if there is no such file.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"no URDF at {path}; give the path of a .urdf file")
    return Scene(path.stem, urdf_path=path.resolve())


def _start_and_goals(
    floor: FloorMap, rng: np.random.Generator, num_goals: int = 5
) -> tuple[PlanarPose, tuple[PlanarPose, ...]] | None:
    """Draw a start and goals in the largest connected free region; None if it is too small."""
    regions = floor.regions(BASE_RADIUS)
    if not regions.any():
        return None
    largest = np.bincount(regions[regions > 0]).argmax()
    cells = np.argwhere(regions == largest)
    positions = np.stack((floor.x[cells[:, 0]], floor.y[cells[:, 1]]), axis=-1)
    start = positions[rng.integers(len(positions))]
    far = positions[np.linalg.norm(positions - start, axis=-1) >= TRAVEL]
    if len(far) < num_goals:
        return None
    goals = far[rng.choice(len(far), num_goals, replace=False)]
    return _facing(start, goals[0]), tuple(_facing(goal, 2 * goal - start) for goal in goals)


def _facing(position: np.ndarray, towards: np.ndarray) -> PlanarPose:
    x, y = (towards - position).tolist()
    return float(position[0]), float(position[1]), float(np.arctan2(y, x))
