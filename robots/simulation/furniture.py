"""Furniture as groups of primitives; every builder works in the piece's own frame.

The frame of a piece stands on the floor (z = 0) at the middle of its footprint; x runs along its width and
its front looks towards -y.
"""

from __future__ import annotations

import numpy as np

from robots.simulation.poses import planar_pose
from robots.simulation.primitives import Box, Colour, Cylinder, Primitive, Sphere

WOOD: Colour = (0.72, 0.53, 0.34)
DARK_WOOD: Colour = (0.45, 0.31, 0.2)
WHITE: Colour = (0.92, 0.92, 0.9)
GREY: Colour = (0.45, 0.47, 0.5)
METAL: Colour = (0.62, 0.64, 0.67)
BLUE: Colour = (0.25, 0.38, 0.55)
RED: Colour = (0.7, 0.25, 0.2)
GREEN: Colour = (0.3, 0.5, 0.3)

Parts = tuple[Primitive, ...]


def placed(parts: Parts, x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> Parts:
    """Carry a piece from its own frame to (x, y, z) [m] in the room, turned by `yaw` [rad]."""
    T_room_piece = planar_pose(x, y, z, yaw)
    return tuple(part.at(T_room_piece @ part.pose) for part in parts)


def _box(
    name: str, size: tuple[float, float, float], x: float, y: float, bottom: float, colour: Colour
) -> Box:
    return Box(name, planar_pose(x, y, bottom + size[2] / 2), size, colour=colour)


def table(
    name: str, width: float, depth: float, height: float, colour: Colour = WOOD, thickness: float = 0.04
) -> Parts:
    """Build a top on four square legs, `height` [m] to the upper face."""
    leg, inset = 0.05, 0.06
    x, y = width / 2 - inset, depth / 2 - inset
    corners = [(-x, -y), (x, -y), (-x, y), (x, y)]
    legs = [
        _box(f"{name}.leg{i}", (leg, leg, height - thickness), cx, cy, 0.0, colour)
        for i, (cx, cy) in enumerate(corners)
    ]
    return (_box(f"{name}.top", (width, depth, thickness), 0.0, 0.0, height - thickness, colour), *legs)


def round_table(name: str, radius: float, height: float, colour: Colour = WOOD) -> Parts:
    """Build a round top on a column with a round foot."""
    return (
        Cylinder(f"{name}.top", planar_pose(0, 0, height - 0.02), radius, 0.04, colour=colour),
        Cylinder(f"{name}.column", planar_pose(0, 0, height / 2), 0.05, height - 0.08, colour=METAL),
        Cylinder(f"{name}.foot", planar_pose(0, 0, 0.02), 0.5 * radius, 0.04, colour=METAL),
    )


def chair(name: str, colour: Colour = DARK_WOOD) -> Parts:
    """Build a chair of 0.42 x 0.42 m: seat at 0.45 m, back to 0.88 m on its +y side, four legs."""
    seat = table(name, 0.42, 0.42, 0.45, colour)
    return (*seat, _box(f"{name}.back", (0.42, 0.04, 0.42), 0.0, 0.19, 0.46, colour))


def office_chair(name: str, colour: Colour = GREY) -> Parts:
    """Build a swivel chair: round seat and foot on a column, and a back."""
    return (
        Cylinder(f"{name}.foot", planar_pose(0, 0, 0.04), 0.26, 0.06, colour=METAL),
        Cylinder(f"{name}.column", planar_pose(0, 0, 0.25), 0.035, 0.38, colour=METAL),
        Cylinder(f"{name}.seat", planar_pose(0, 0, 0.47), 0.24, 0.07, colour=colour),
        _box(f"{name}.back", (0.4, 0.05, 0.5), 0.0, 0.22, 0.5, colour),
    )


def shelf(
    name: str, width: float, height: float, boards: int = 4, depth: float = 0.32, colour: Colour = WOOD
) -> Parts:
    """Build an open shelf: sides, a back and `boards` boards, the lowest 6 cm up and the highest on top."""
    side = 0.025
    back = _box(f"{name}.back", (width, 0.015, height), 0.0, depth / 2.0 - 0.0075, 0.0, colour)
    sides = [
        _box(f"{name}.side{i}", (side, depth, height), sx * (width - side) / 2.0, 0.0, 0.0, colour)
        for i, sx in enumerate((-1, 1))
    ]
    bottoms = np.linspace(0.06, height - side, boards)
    inner = width - 2 * side
    rows = [
        _box(f"{name}.board{i}", (inner, depth, side), 0.0, 0.0, z, colour)
        for i, z in enumerate(bottoms.tolist())
    ]
    return (back, *sides, *rows)


def books(name: str, width: float, colour: Colour) -> Parts:
    """Build a row of books 0.24 m high with its own bottom at z = 0, for a shelf board."""
    return (_box(name, (width, 0.18, 0.24), 0.0, 0.0, 0.0, colour),)


def sofa(name: str, width: float = 1.9, colour: Colour = BLUE) -> Parts:
    """Build a sofa 0.85 m deep: base, two arm rests, and a back on its +y side."""
    arm = 0.18
    return (
        _box(f"{name}.base", (width - 2.0 * arm, 0.85, 0.42), 0.0, 0.0, 0.0, colour),
        _box(f"{name}.back", (width - 2.0 * arm, 0.2, 0.43), 0.0, 0.325, 0.42, colour),
        *[
            _box(f"{name}.arm{i}", (arm, 0.85, 0.6), s * (width - arm) / 2.0, 0.0, 0.0, colour)
            for i, s in enumerate((-1, 1))
        ],
    )


def armchair(name: str, colour: Colour = RED) -> Parts:
    """Build a sofa for one."""
    return sofa(name, 0.85, colour)


def cupboard(name: str, width: float, height: float, depth: float = 0.45, colour: Colour = WHITE) -> Parts:
    """Build a closed cupboard with a plinth and two knobs."""
    knobs = [
        Sphere(f"{name}.knob{i}", planar_pose(s * 0.06, -depth / 2 - 0.015, 0.6 * height), 0.02, colour=METAL)
        for i, s in enumerate((-1, 1))
    ]
    return (
        _box(f"{name}.body", (width, depth, height - 0.08), 0.0, 0.0, 0.08, colour),
        _box(f"{name}.plinth", (width - 0.04, depth - 0.08, 0.08), 0.0, 0.02, 0.0, GREY),
        *knobs,
    )


def counter(name: str, width: float, colour: Colour = WHITE) -> Parts:
    """Build a kitchen counter 0.6 m deep and 0.9 m high, with a tap and a hanging cupboard above."""
    return (
        _box(f"{name}.body", (width, 0.58, 0.86), 0.0, 0.01, 0.0, colour),
        _box(f"{name}.worktop", (width, 0.6, 0.04), 0.0, 0.0, 0.86, DARK_WOOD),
        _box(f"{name}.hanging", (width, 0.34, 0.6), 0.0, 0.13, 1.45, colour),
        Cylinder(f"{name}.tap", planar_pose(0.25 * width, 0.18, 1.02), 0.018, 0.24, colour=METAL),
    )


def floor_lamp(name: str) -> Parts:
    """Build a floor lamp 1.6 m high: foot, rod and a round shade."""
    return (
        Cylinder(f"{name}.foot", planar_pose(0, 0, 0.015), 0.14, 0.03, colour=GREY),
        Cylinder(f"{name}.rod", planar_pose(0, 0, 0.75), 0.015, 1.44, colour=METAL),
        Sphere(f"{name}.shade", planar_pose(0, 0, 1.5), 0.16, colour=(0.95, 0.9, 0.7)),
    )


def plant(name: str) -> Parts:
    """Build a potted plant 1.2 m high."""
    return (
        Cylinder(f"{name}.pot", planar_pose(0, 0, 0.16), 0.16, 0.32, colour=RED),
        Cylinder(f"{name}.stem", planar_pose(0, 0, 0.5), 0.02, 0.4, colour=DARK_WOOD),
        Sphere(f"{name}.leaves", planar_pose(0, 0, 0.92), 0.26, colour=GREEN),
    )


def monitor(name: str) -> Parts:
    """Build a screen on a foot with its own bottom at z = 0, looking towards -y, for a desk top."""
    return (
        _box(f"{name}.foot", (0.2, 0.16, 0.02), 0.0, 0.0, 0.0, GREY),
        _box(f"{name}.neck", (0.04, 0.03, 0.14), 0.0, 0.03, 0.02, GREY),
        _box(f"{name}.screen", (0.55, 0.03, 0.32), 0.0, 0.0, 0.12, (0.12, 0.12, 0.14)),
    )


def television(name: str) -> Parts:
    """Build a low board with a large screen standing on it, looking towards -y."""
    return (
        _box(f"{name}.board", (1.6, 0.4, 0.45), 0.0, 0.0, 0.0, DARK_WOOD),
        _box(f"{name}.foot", (0.5, 0.2, 0.04), 0.0, 0.0, 0.45, GREY),
        _box(f"{name}.screen", (1.15, 0.05, 0.66), 0.0, 0.0, 0.49, (0.1, 0.1, 0.12)),
    )


def bed(name: str) -> Parts:
    """Build a bed of 1.4 x 2 m whose head end is on its +y side."""
    return (
        _box(f"{name}.frame", (1.4, 2.0, 0.28), 0.0, 0.0, 0.04, WOOD),
        _box(f"{name}.mattress", (1.34, 1.94, 0.18), 0.0, 0.0, 0.32, WHITE),
        _box(f"{name}.head", (1.4, 0.06, 0.95), 0.0, 1.03, 0.0, WOOD),
        _box(f"{name}.pillow", (0.6, 0.35, 0.1), -0.3, 0.72, 0.5, BLUE),
    )


def stool(name: str) -> Parts:
    """Build a bar stool 0.65 m high: seat, column and foot."""
    return (
        Cylinder(f"{name}.seat", planar_pose(0, 0, 0.62), 0.17, 0.06, colour=DARK_WOOD),
        Cylinder(f"{name}.column", planar_pose(0, 0, 0.31), 0.03, 0.56, colour=METAL),
        Cylinder(f"{name}.foot", planar_pose(0, 0, 0.015), 0.17, 0.03, colour=METAL),
    )


def island(name: str, width: float) -> Parts:
    """Build a kitchen island 0.9 m high whose worktop of 0.6 m juts out over its -y side."""
    return (
        _box(f"{name}.body", (width - 0.1, 0.4, 0.86), 0.0, 0.08, 0.0, WHITE),
        _box(f"{name}.worktop", (width, 0.6, 0.04), 0.0, 0.0, 0.86, DARK_WOOD),
    )


def table_lamp(name: str) -> Parts:
    """Build a lamp 0.45 m high with its own bottom at z = 0, to stand on a piece."""
    return (
        Cylinder(f"{name}.foot", planar_pose(0, 0, 0.01), 0.07, 0.02, colour=GREY),
        Cylinder(f"{name}.rod", planar_pose(0, 0, 0.135), 0.012, 0.23, colour=METAL),
        Cylinder(f"{name}.shade", planar_pose(0, 0, 0.35), 0.12, 0.2, colour=(0.95, 0.9, 0.7)),
    )


def vase(name: str) -> Parts:
    """Build a vase with a ball of flowers, its own bottom at z = 0, to stand on a piece."""
    return (
        Cylinder(f"{name}.pot", planar_pose(0, 0, 0.1), 0.05, 0.2, colour=BLUE),
        Sphere(f"{name}.flowers", planar_pose(0, 0, 0.29), 0.11, colour=RED),
    )


def pendant(name: str, ceiling: float) -> Parts:
    """Build a round lamp that hangs from a ceiling [m], its lowest point at 1.7 m."""
    length = ceiling - 2.0
    return (
        Sphere(f"{name}.shade", planar_pose(0, 0, 1.87), 0.17, colour=(0.95, 0.9, 0.7)),
        Cylinder(f"{name}.rod", planar_pose(0, 0, ceiling - length / 2), 0.01, length, colour=METAL),
    )


def picture(name: str, width: float, height: float, bottom: float = 1.3) -> Parts:
    """Build a picture 3 cm thick to hang on a wall."""
    return (_box(name, (width, 0.03, height), 0.0, 0.0, bottom, DARK_WOOD),)


def bag(name: str) -> Parts:
    """Build a travel bag that stands on the floor, with its handle."""
    return (
        _box(f"{name}.body", (0.36, 0.2, 0.42), 0.0, 0.0, 0.0, RED),
        _box(f"{name}.handle", (0.16, 0.03, 0.08), 0.0, 0.0, 0.42, GREY),
    )


def bin_(name: str) -> Parts:
    """Build a waste bin 0.4 m high."""
    return (Cylinder(name, planar_pose(0, 0, 0.2), 0.13, 0.4, colour=GREY),)


def room_shell(width: float, depth: float, height: float = 2.6, thickness: float = 0.12) -> Parts:
    """Build floor and four walls round the free volume |x| < width / 2, |y| < depth / 2, 0 < z < height."""
    t = thickness
    x, y = (width + t) / 2, (depth + t) / 2
    grey: Colour = (0.86, 0.85, 0.82)
    return (
        Box("floor", planar_pose(0, 0, -t / 2), (width + 2 * t, depth + 2 * t, t), colour=(0.6, 0.52, 0.44)),
        _box("wall.west", (t, depth + 2.0 * t, height), -x, 0.0, 0.0, grey),
        _box("wall.east", (t, depth + 2.0 * t, height), x, 0.0, 0.0, grey),
        _box("wall.south", (width, t, height), 0.0, -y, 0.0, grey),
        _box("wall.north", (width, t, height), 0.0, y, 0.0, grey),
    )
