"""The furnished rooms: where the pieces of furniture and the things on them stand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from robots.simulation import furniture as fn
from robots.simulation.poses import planar_pose
from robots.simulation.primitives import Box, Cylinder, Primitive

QUARTER = np.pi / 2
GRASP_TABLE_HEIGHT = 0.7
PARK_DISTANCE = 0.55
"""From the front edge of the grasp table to the middle of the parked base [m]."""


@dataclass(frozen=True)
class GraspTask:
    """One object to pick up, and where a mobile base can park to reach it.

    Attributes:
        object_name: the object to grasp, standing near the front edge of `table_name`.
        table_name: the table it stands on; its solids are named `<table_name>.<part>`.
        park: base pose (x, y, yaw) [m, rad] in front of the table, facing the object.
    """

    object_name: str
    table_name: str
    park: tuple[float, float, float]


@dataclass
class Layout:
    """A room being furnished; every piece is jittered as it is put down."""

    size: tuple[float, float, float]
    rng: np.random.Generator
    static: list[Primitive] = field(default_factory=list)
    objects: list[Primitive] = field(default_factory=list)
    grasp: GraspTask | None = None

    def put(
        self, parts: fn.Parts, x: float, y: float, yaw: float = 0.0, shift: float = 0.05, turn: float = 4.0
    ) -> np.ndarray:
        """Put a piece near (x, y) [m], within `shift` [m] and `turn` [degrees]; return its pose (4, 4)."""
        x, y = x + self.rng.uniform(-shift, shift), y + self.rng.uniform(-shift, shift)
        yaw = yaw + np.radians(self.rng.uniform(-turn, turn))
        self.static += fn.placed(parts, x, y, yaw)
        return planar_pose(x, y, yaw=yaw)

    def put_by_wall(
        self, parts: fn.Parts, along: float, wall: str, depth: float, shift: float = 0.06
    ) -> np.ndarray:
        """Put a piece of given depth [m] with its back 2 cm off a wall; jitter it only along the wall."""
        along += self.rng.uniform(-shift, shift)
        gap = depth / 2 + 0.02
        width, length = self.size[:2]
        x, y, yaw = {
            "north": (along, length / 2 - gap, 0.0),
            "south": (along, gap - length / 2, np.pi),
            "west": (gap - width / 2, along, QUARTER),
            "east": (width / 2 - gap, along, -QUARTER),
        }[wall]
        self.static += fn.placed(parts, x, y, yaw)
        return planar_pose(x, y, yaw=yaw)

    def put_on(self, piece: np.ndarray, height: float, parts: fn.Parts, x: float, y: float) -> None:
        """Put static parts onto a piece at `height` [m], at (x, y) [m] in the piece's frame."""
        T_room_parts = piece @ planar_pose(x, y, height)
        self.static += (part.at(T_room_parts @ part.pose) for part in parts)

    def drop(self, piece: np.ndarray, height: float, thing: Primitive, x: float, y: float) -> None:
        """Stand a movable object on a piece at `height` [m], near (x, y) [m] in the piece's frame."""
        half = float(np.ptp(thing.local_mesh().bounds[:, 2])) / 2
        x, y = x + self.rng.uniform(-0.02, 0.02), y + self.rng.uniform(-0.02, 0.02)
        turn = 0.0 if isinstance(thing, Cylinder) else self.rng.uniform(-np.pi, np.pi)
        self.objects.append(thing.at(piece @ planar_pose(x, y, height + half, turn)))

    def put_chairs(self, name: str, table: np.ndarray, places: list[tuple[float, float, float]]) -> None:
        """Put chairs round a table at (x, y, yaw) in the table's frame, slightly pulled out at random."""
        for i, (x, y, yaw) in enumerate(places):
            pose = table @ planar_pose(x, y, yaw=yaw) @ planar_pose(0, self.rng.uniform(0, 0.08))
            heading = float(np.arctan2(pose[1, 0], pose[0, 0]))
            self.put(fn.chair(f"{name}{i}"), pose[0, 3], pose[1, 3], heading, shift=0.02, turn=8.0)

    def put_grasp_table(self, along: float, wall: str) -> None:
        """Put the grasp table by a wall with one object to grasp near its edge and two behind it."""
        depth = 0.6
        piece = self.put_by_wall(
            fn.table("grasp_table", 0.95, depth, GRASP_TABLE_HEIGHT), along, wall, depth, shift=0.1
        )
        x = float(self.rng.uniform(-0.2, 0.2))
        kind = ("box", "can")[self.rng.integers(2)]
        thing = small_box("grasp_object") if kind == "box" else can("grasp_object")
        turn = float(self.rng.uniform(-0.3, 0.3)) if kind == "box" else 0.0
        T_table_object = planar_pose(x, 0.1 - depth / 2, GRASP_TABLE_HEIGHT + 0.06, turn)
        self.objects.append(thing.at(piece @ T_table_object))
        side = float(self.rng.choice((-0.34, 0.34)))
        self.drop(piece, GRASP_TABLE_HEIGHT, can("spare_can"), side, 0.1)
        self.drop(piece, GRASP_TABLE_HEIGHT, bowl("spare_bowl"), -side, 0.12)
        park = piece @ planar_pose(x, -depth / 2 - PARK_DISTANCE, yaw=QUARTER)
        heading = float(np.arctan2(park[1, 0], park[0, 0]))
        self.grasp = GraspTask("grasp_object", "grasp_table", (float(park[0, 3]), float(park[1, 3]), heading))


def small_box(name: str) -> Box:
    """Make a box of 5 x 5 x 12 cm and 0.2 kg."""
    return Box(name, np.eye(4), (0.05, 0.05, 0.12), colour=(0.85, 0.45, 0.1), mass=0.2, friction=0.9)


def can(name: str) -> Cylinder:
    """Make a can of 3 cm radius, 12 cm tall, 0.2 kg."""
    return Cylinder(name, np.eye(4), 0.03, 0.12, colour=(0.8, 0.1, 0.15), mass=0.2, friction=0.9)


def bowl(name: str) -> Cylinder:
    """Make a shallow dish of 7 cm radius and 0.3 kg, a solid puck to the simulator."""
    return Cylinder(name, np.eye(4), 0.07, 0.06, colour=(0.3, 0.6, 0.75), mass=0.3, friction=0.8)


def parcel(name: str) -> Box:
    """Make a parcel of 25 x 18 x 10 cm and 0.5 kg."""
    return Box(name, np.eye(4), (0.25, 0.18, 0.1), colour=(0.75, 0.6, 0.4), mass=0.5, friction=0.8)


def fill_shelf(layout: Layout, name: str, piece: np.ndarray, heights: list[float], width: float) -> None:
    """Put a row of books on each board whose top is at one of the heights [m] of a shelf of inner width [m]."""
    colours = (fn.RED, fn.GREEN, fn.BLUE, fn.GREY)
    for i, height in enumerate(heights):
        length = float(layout.rng.uniform(0.3, 0.8)) * width
        x = float(layout.rng.uniform(-1, 1)) * (width - length) / 2
        layout.put_on(piece, height, fn.books(f"{name}.books{i}", length, colours[i % 4]), x, 0.02)


def _apartment(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    counter = by_wall(fn.counter("counter", 2.4), 2.45, "north", 0.6)
    layout.drop(counter, 0.9, can("counter_can"), -0.8, 0.0)
    layout.drop(counter, 0.9, bowl("counter_bowl"), -0.3, -0.05)
    by_wall(fn.cupboard("fridge", 0.62, 1.8, 0.6), 0.75, "north", 0.63)
    dining = put(fn.table("dining_table", 1.4, 0.8, 0.74), 1.95, 0.15)
    south, north = (-0.52, np.pi), (0.52, 0.0)
    layout.put_chairs("chair", dining, [(-0.34, *south), (0.34, *south), (-0.34, *north), (0.34, *north)])
    layout.drop(dining, 0.74, bowl("fruit_bowl"), 0.1, 0.05)
    layout.drop(dining, 0.74, parcel("dining_parcel"), -0.35, -0.1)
    by_wall(fn.television("television"), 0.0, "west", 0.4)
    put(fn.sofa("sofa"), -1.05, 0.0, -QUARTER)
    coffee = put(fn.table("coffee_table", 0.9, 0.5, 0.42, fn.DARK_WOOD), -2.2, 0.0, QUARTER)
    layout.drop(coffee, 0.42, parcel("coffee_parcel"), 0.15, 0.05)
    shelf = by_wall(fn.shelf("shelf", 1.4, 1.8, boards=5), -2.3, "north", 0.32)
    fill_shelf(layout, "shelf", shelf, [0.085, 0.51, 0.94, 1.37], 1.3)
    cupboard = by_wall(fn.cupboard("sideboard", 1.2, 0.85), -0.9, "south", 0.45)
    layout.drop(cupboard, 0.85, bowl("sideboard_bowl"), 0.2, 0.0)
    put(fn.armchair("armchair"), -3.1, -2.1, 0.75 * np.pi)
    put(fn.floor_lamp("lamp"), -3.45, 2.35)
    put(fn.plant("plant"), 3.4, -2.4)
    layout.put_grasp_table(1.9, "south")


def _office(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    for i, y in enumerate((1.75, -0.55)):
        desk = by_wall(fn.table(f"desk{i}", 1.5, 0.72, 0.74, fn.WHITE), y, "west", 0.72)
        layout.put_on(desk, 0.74, fn.monitor(f"monitor{i}"), 0.1, 0.15)
        layout.drop(desk, 0.74, can(f"desk_can{i}"), -0.5, 0.0)
        put(fn.office_chair(f"office_chair{i}"), -2.95, y, -QUARTER, turn=20.0)
    meeting = put(fn.table("meeting_table", 2.0, 1.0, 0.74, fn.DARK_WOOD), 1.25, 0.35)
    south, north = (-0.62, np.pi), (0.62, 0.0)
    places = [(x, *side) for side in (south, north) for x in (-0.65, 0.0, 0.65)]
    layout.put_chairs("meeting_chair", meeting, places)
    layout.drop(meeting, 0.74, parcel("meeting_parcel"), -0.5, 0.1)
    layout.drop(meeting, 0.74, bowl("meeting_bowl"), 0.4, 0.0)
    for i, x in enumerate((-0.9, 0.4)):
        case = by_wall(fn.shelf(f"bookcase{i}", 1.2, 2.0, boards=6), x, "north", 0.32)
        fill_shelf(layout, f"bookcase{i}", case, [0.085, 0.468, 0.851, 1.234], 1.1)
    put((Box("partition", planar_pose(0, 0, 0.75), (1.8, 0.06, 1.5), colour=fn.BLUE),), -1.15, -0.82, QUARTER)
    put((Cylinder("pillar", planar_pose(0, 0, 1.3), 0.2, 2.6, colour=fn.WHITE),), -1.15, 0.75)
    by_wall(fn.sofa("sofa", 1.8, fn.GREEN), 0.9, "south", 0.85)
    cupboard = by_wall(fn.cupboard("filing", 1.6, 1.1), 1.0, "east", 0.48)
    printer = Box("printer", planar_pose(0, 0, 0.15), (0.45, 0.38, 0.3), colour=fn.GREY)
    layout.put_on(cupboard, 1.1, (printer,), 0.3, 0.0)
    put(fn.plant("plant"), 3.55, 2.55)
    put(fn.floor_lamp("lamp"), -3.6, -2.6)
    layout.put_grasp_table(-1.6, "east")


def _flat(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    x, low, high, top = 0.6, -1.0, 0.2, 2.05
    edge, ceiling = layout.size[1] / 2, layout.size[2]
    spans = {"south": (-edge, low, 0.0), "north": (high, edge, 0.0), "lintel": (low, high, top)}
    for name, (y0, y1, bottom) in spans.items():
        centre = planar_pose(x, (y0 + y1) / 2, (bottom + ceiling) / 2)
        wall = Box(f"inner_wall.{name}", centre, (0.12, y1 - y0, ceiling - bottom), colour=fn.WHITE)
        layout.static.append(wall)
    by_wall(fn.sofa("sofa", 1.8, fn.RED), 0.7, "west", 0.85)
    dining = put(fn.round_table("dining_table", 0.5, 0.74), -1.2, 0.1)
    layout.put_chairs("chair", dining, [(0.0, 0.6, 0.0), (0.0, -0.6, np.pi)])
    layout.drop(dining, 0.74, bowl("fruit_bowl"), 0.05, 0.0)
    counter = by_wall(fn.counter("counter", 2.2), -2.5, "south", 0.6)
    layout.drop(counter, 0.9, can("counter_can"), 0.5, 0.0)
    shelf = by_wall(fn.shelf("shelf", 1.2, 1.6), -1.9, "north", 0.32)
    fill_shelf(layout, "shelf", shelf, [0.085, 0.59, 1.1], 1.1)
    put(fn.plant("plant"), -3.55, 2.25)
    by_wall(fn.bed("bed"), 3.1, "north", 2.12)
    by_wall(fn.cupboard("wardrobe", 1.2, 2.0, 0.55), 1.4, "north", 0.58)
    put(fn.floor_lamp("lamp"), 3.65, -2.3)
    layout.put_grasp_table(2.4, "south")


ROOMS: dict[str, tuple[tuple[float, float, float], Callable[[Layout], None]]] = {
    "apartment": ((7.6, 5.6, 2.6), _apartment),
    "office": ((8.0, 6.0, 2.6), _office),
    "flat": ((8.0, 5.4, 2.6), _flat),
}
"""By scene name: free width, depth and height [m], and the function that furnishes the room."""
