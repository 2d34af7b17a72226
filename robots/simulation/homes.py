"""Furnished homes under a ceiling, of the size and density of ReplicaCAD's apartments (iSDF section 5)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robots.simulation import furniture as fn
from robots.simulation.poses import planar_pose
from robots.simulation.primitives import Box, Cylinder
from robots.simulation.rooms import QUARTER, Layout, bowl, can, fill_shelf, parcel


def _enclose(layout: Layout, x: float, low: float, high: float) -> None:
    """Close the room with a ceiling, and part it by a wall at x [m] that reaches from y = low to high."""
    width, depth, height = layout.size
    ceiling = Box("ceiling", planar_pose(0, 0, height + 0.06), (width, depth, 0.12), colour=fn.WHITE)
    pose = planar_pose(x, (low + high) / 2, height / 2)
    layout.static += [ceiling, Box("inner_wall", pose, (0.12, high - low, height), colour=fn.WHITE)]


def _home_1(layout: Layout) -> None:
    _enclose(layout, 0.6, 1.0, layout.size[1] / 2)
    _living_room_1(layout)
    _kitchen_1(layout)
    layout.put_grasp_table(1.9, "south")


def _living_room_1(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    by_wall(fn.television("television"), 0.3, "west", 0.4)
    put(fn.sofa("sofa"), -1.3, 0.3, -QUARTER)
    coffee = put(fn.table("coffee_table", 0.9, 0.5, 0.42, fn.DARK_WOOD), -2.45, 0.3, QUARTER)
    layout.put_on(coffee, 0.42, fn.vase("coffee_table.vase"), -0.25, 0.0)
    layout.drop(coffee, 0.42, parcel("coffee_parcel"), 0.2, 0.03)
    side = put(fn.round_table("side_table", 0.25, 0.55), -1.3, -1.05)
    layout.put_on(side, 0.55, fn.table_lamp("side_table.lamp"), 0.0, 0.0)
    put(fn.armchair("armchair"), -3.2, -2.2, 0.75 * np.pi)
    put(fn.floor_lamp("lamp"), -3.6, 2.6)
    put(fn.plant("plant0"), -3.6, 1.75)
    case = by_wall(fn.shelf("shelf", 1.4, 1.8, boards=5), -2.2, "north", 0.32)
    fill_shelf(layout, "shelf", case, [0.085, 0.51, 0.94, 1.37], 1.3)
    desk = by_wall(fn.table("desk", 1.1, 0.6, 0.74, fn.WHITE), -0.4, "north", 0.6)
    layout.put_on(desk, 0.74, fn.monitor("monitor"), 0.1, 0.12)
    layout.drop(desk, 0.74, can("desk_can"), -0.4, 0.0)
    put(fn.office_chair("office_chair"), -0.4, 2.0, 0.75 * np.pi, turn=15.0)
    put(fn.bag("bag"), 0.38, 1.8, QUARTER, shift=0.02)
    sideboard = by_wall(fn.cupboard("sideboard", 1.2, 0.85), -0.9, "south", 0.45)
    layout.put_on(sideboard, 0.85, fn.table_lamp("sideboard.lamp"), -0.4, 0.02)
    layout.drop(sideboard, 0.85, bowl("sideboard_bowl"), 0.2, 0.0)
    by_wall(fn.picture("picture0", 0.9, 0.6, 1.45), -0.9, "south", 0.03)


def _kitchen_1(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    counter = by_wall(fn.counter("counter", 2.4), 2.45, "north", 0.6)
    layout.drop(counter, 0.9, can("counter_can"), -0.8, 0.0)
    layout.drop(counter, 0.9, bowl("counter_bowl"), -0.3, -0.05)
    by_wall(fn.cupboard("fridge", 0.62, 1.8, 0.6), 1.8, "east", 0.63)
    put(fn.bin_("bin"), 0.95, 2.75, shift=0.03)
    dining = put(fn.table("dining_table", 1.4, 0.8, 0.74), 2.2, 0.2)
    south, north = (-0.52, np.pi), (0.52, 0.0)
    layout.put_chairs("chair", dining, [(-0.34, *south), (0.34, *south), (-0.34, *north), (0.34, *north)])
    layout.put_on(dining, 0.74, fn.vase("dining_table.vase"), 0.35, 0.05)
    layout.drop(dining, 0.74, bowl("fruit_bowl"), -0.1, 0.05)
    put(fn.pendant("pendant", layout.size[2]), 2.2, 0.2)
    by_wall(fn.picture("picture1", 0.7, 0.9, 1.2), -0.9, "east", 0.03)
    put(fn.plant("plant1"), 3.55, -2.55)


def _home_2(layout: Layout) -> None:
    _enclose(layout, -0.4, -layout.size[1] / 2, -1.2)
    _bedroom_2(layout)
    _living_room_2(layout)
    _kitchen_2(layout)
    layout.put_grasp_table(-0.7, "north")


def _bedroom_2(layout: Layout) -> None:
    by_wall = layout.put_by_wall
    by_wall(fn.bed("bed"), -1.9, "west", 2.12)
    night = by_wall(fn.cupboard("nightstand", 0.45, 0.5, 0.4), -0.8, "west", 0.43)
    layout.put_on(night, 0.5, fn.table_lamp("nightstand.lamp"), 0.0, 0.0)
    by_wall(fn.cupboard("wardrobe", 0.9, 2.0, 0.55), -1.0, "south", 0.58)
    by_wall(fn.picture("picture0", 1.0, 0.6), -1.9, "west", 0.03)


def _living_room_2(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    put(fn.television("television"), -0.02, -2.1, QUARTER, shift=0.03, turn=2.0)
    by_wall(fn.sofa("sofa", 2.1, fn.GREEN), -1.5, "east", 0.85)
    coffee = put(fn.round_table("coffee_table", 0.4, 0.42, fn.DARK_WOOD), 2.15, -1.4)
    layout.put_on(coffee, 0.42, fn.vase("coffee_table.vase"), 0.1, 0.1)
    layout.drop(coffee, 0.42, bowl("coffee_bowl"), -0.15, 0.0)
    put(fn.armchair("armchair"), 2.25, -2.6, np.pi)
    put(fn.floor_lamp("lamp0"), 1.35, -2.85)
    by_wall(fn.picture("picture1", 1.2, 0.7), -1.5, "east", 0.03)
    sideboard = by_wall(fn.cupboard("sideboard", 1.2, 0.85), 0.6, "east", 0.45)
    layout.put_on(sideboard, 0.85, fn.vase("sideboard.vase"), -0.35, 0.0)
    layout.drop(sideboard, 0.85, parcel("sideboard_parcel"), 0.2, 0.0)


def _kitchen_2(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    counter = by_wall(fn.counter("counter", 2.2), 2.3, "north", 0.6)
    layout.drop(counter, 0.9, can("counter_can"), 0.8, 0.0)
    kettle = Cylinder("counter_kettle", np.eye(4), 0.08, 0.22, colour=fn.METAL, mass=0.6)
    layout.drop(counter, 0.9, kettle, -0.6, 0.0)
    by_wall(fn.cupboard("fridge", 0.62, 1.8, 0.6), 0.72, "north", 0.63)
    put(fn.bin_("bin"), 0.13, 2.95, shift=0.03)
    island = put(fn.island("island", 1.4), 1.7, 1.3)
    layout.drop(island, 0.9, bowl("island_bowl"), -0.3, 0.0)
    for i, x in enumerate((-0.35, 0.35)):
        put(fn.stool(f"stool{i}"), 1.7 + x, 0.78)
    dining = put(fn.round_table("dining_table", 0.55, 0.74), -2.4, 0.9)
    layout.put_chairs("chair", dining, [(0.0, 0.65, 0.0), (0.0, -0.65, np.pi), (0.65, 0.0, -QUARTER)])
    layout.drop(dining, 0.74, bowl("fruit_bowl"), 0.1, 0.0)
    put(fn.pendant("pendant", layout.size[2]), -2.4, 0.9)
    case = by_wall(fn.shelf("shelf", 1.2, 1.6), 1.75, "west", 0.32)
    fill_shelf(layout, "shelf", case, [0.085, 0.59, 1.1], 1.1)
    put(fn.floor_lamp("lamp1"), -3.5, 0.1)
    put(fn.plant("plant"), -3.4, 2.8)
    put(fn.bag("bag"), -1.65, 2.98, shift=0.03)


def _home_3(layout: Layout) -> None:
    _enclose(layout, 1.3, -layout.size[1] / 2, -0.7)
    _living_room_3(layout)
    _kitchen_3(layout)
    _study_3(layout)
    layout.put_grasp_table(0.35, "south")


def _living_room_3(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    by_wall(fn.television("television"), -1.3, "west", 0.4)
    put(fn.sofa("sofa", 2.0, fn.GREY), -1.0, -1.3, -QUARTER)
    coffee = put(fn.round_table("coffee_table", 0.38, 0.42), -2.3, -1.3)
    layout.drop(coffee, 0.42, bowl("coffee_bowl"), 0.1, 0.0)
    put(fn.armchair("armchair", fn.GREEN), -2.35, -2.4, np.pi, shift=0.03)
    put(fn.floor_lamp("lamp"), -1.45, -2.68, shift=0.03)
    put(fn.plant("plant0"), -3.28, -2.58, shift=0.03)
    dining = put(fn.table("dining_table", 1.5, 0.85, 0.74, fn.DARK_WOOD), -1.7, 1.35)
    south, north = (-0.55, np.pi), (0.55, 0.0)
    layout.put_chairs("chair", dining, [(-0.37, *south), (0.37, *south), (-0.37, *north), (0.37, *north)])
    layout.put_on(dining, 0.74, fn.vase("dining_table.vase"), -0.3, 0.0)
    layout.drop(dining, 0.74, bowl("fruit_bowl"), 0.2, 0.05)
    put(fn.pendant("pendant", layout.size[2]), -1.7, 1.35)
    sideboard = by_wall(fn.cupboard("sideboard", 1.3, 0.85), -1.7, "north", 0.45)
    layout.put_on(sideboard, 0.85, fn.table_lamp("sideboard.lamp"), 0.4, 0.02)
    by_wall(fn.picture("picture0", 1.1, 0.7), -1.7, "north", 0.03)
    case = by_wall(fn.shelf("shelf", 1.2, 1.8, boards=5), 1.7, "west", 0.32)
    fill_shelf(layout, "shelf", case, [0.085, 0.51, 0.94, 1.37], 1.1)


def _kitchen_3(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    counter = by_wall(fn.counter("counter", 2.4), 1.85, "north", 0.6)
    layout.drop(counter, 0.9, can("counter_can"), -0.7, 0.0)
    by_wall(fn.cupboard("fridge", 0.62, 1.9, 0.6), 1.75, "east", 0.63)
    island = put(fn.island("island", 1.3), 1.5, 0.9)
    layout.drop(island, 0.9, bowl("island_bowl"), 0.3, 0.0)
    for i, x in enumerate((-0.32, 0.32)):
        put(fn.stool(f"stool{i}"), 1.5 + x, 0.38)
    put(fn.bin_("bin"), 0.4, 2.68, shift=0.03)


def _study_3(layout: Layout) -> None:
    put, by_wall = layout.put, layout.put_by_wall
    desk = by_wall(fn.table("desk", 1.2, 0.6, 0.74, fn.WHITE), -1.7, "east", 0.6)
    layout.put_on(desk, 0.74, fn.monitor("monitor"), -0.1, 0.12)
    layout.drop(desk, 0.74, parcel("desk_parcel"), 0.4, 0.0)
    put(fn.office_chair("office_chair"), 2.65, -1.7, -QUARTER, turn=15.0)
    case = by_wall(fn.shelf("bookcase", 1.0, 1.6), 2.1, "south", 0.32)
    fill_shelf(layout, "bookcase", case, [0.085, 0.59, 1.1], 0.9)
    by_wall(fn.picture("picture1", 0.8, 0.6), -1.7, "east", 0.03)
    put(fn.plant("plant1"), 3.25, -2.55, shift=0.03)


HOMES: dict[str, tuple[tuple[float, float, float], Callable[[Layout], None]]] = {
    "home_1": ((8.0, 6.0, 2.8), _home_1),
    "home_2": ((7.6, 6.4, 2.8), _home_2),
    "home_3": ((7.2, 5.8, 2.6), _home_3),
}
"""By scene name: free width, depth and height [m], and the function that furnishes the home."""
