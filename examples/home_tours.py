"""The nine tours of three homes: exploring (nav), looking at two large objects (obj), going to grasp (mnp)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from examples.camera_tour import Leg


@dataclass(frozen=True)
class HomeTour:
    """A tour through a furnished home.

    Args:
        scene: the home.
        start: base pose x, y [m], yaw [rad].
        legs: driven one after the other.
    """

    scene: str
    start: tuple[float, float, float]
    legs: tuple[Leg, ...]


def _explore(*ways: tuple[tuple[float, float], ...]) -> tuple[Leg, ...]:
    return tuple(Leg(way, speed=0.55) for way in ways)


def _reach(*through: tuple[float, float], final_yaw: float) -> tuple[Leg, ...]:
    return (Leg(through, "grasp_object", final_yaw, speed=0.3, wander=0.2, linger=6.0),)


TOURS: dict[str, HomeTour] = {
    "apt_1_nav": HomeTour(
        "home_1",
        (-0.6, -1.5, 0.0),
        _explore(
            ((1.2, -1.4), (3.3, -1.3)),
            ((3.35, 1.0),),
            ((1.2, 1.5), (0.6, 0.4), (-0.1, 0.4)),
            ((-0.3, -1.2), (-1.4, -1.9), (-3.05, 0.3), (-2.7, 1.9)),
        ),
    ),
    "apt_1_obj": HomeTour(
        "home_1",
        (-2.3, -1.6, 0.3),
        (
            Leg(((-0.2, -1.6), (0.1, 0.3)), "sofa", speed=0.4, wander=0.4),
            Leg(((0.6, -0.8), (1.5, -1.5), (3.2, -1.0)), "dining_table", speed=0.4),
        ),
    ),
    "apt_1_mnp": HomeTour("home_1", (-0.4, -1.1, -0.4), _reach((1.9, -1.83), final_yaw=-math.pi / 2)),
    "apt_2_nav": HomeTour(
        "home_2",
        (-1.05, -1.8, math.pi / 2),
        _explore(
            ((-0.9, -0.5), (0.9, -1.4)),
            ((1.5, -0.2), (2.9, 0.3)),
            ((2.95, 2.05), (1.2, 2.1), (0.4, 1.2)),
            ((-0.8, 1.6), (-2.3, 2.4)),
        ),
    ),
    "apt_2_obj": HomeTour(
        "home_2",
        (0.75, -2.0, 0.9),
        (
            Leg(((1.0, -1.0), (2.0, -0.2)), "sofa", speed=0.4, wander=0.4),
            Leg(((-0.5, 0.2), (-0.7, 1.2), (-1.7, 2.2)), "dining_table", speed=0.4),
        ),
    ),
    "apt_2_mnp": HomeTour("home_2", (0.4, -0.3, 1.8), _reach((-0.7, 2.03), final_yaw=math.pi / 2)),
    "apt_3_nav": HomeTour(
        "home_3",
        (0.2, -1.5, math.pi / 2),
        _explore(
            ((0.1, 0.0), (-2.6, 0.1)),
            ((-0.2, 0.2), (0.0, 1.6), (1.5, 1.75)),
            ((0.2, 1.2), (0.6, -0.1), (2.4, -0.1)),
            ((2.1, -1.2),),
        ),
    ),
    "apt_3_obj": HomeTour(
        "home_3",
        (0.1, -1.7, 2.8),
        (
            Leg(((0.0, -0.4), (-1.0, 0.1), (-2.5, 0.0)), "sofa", speed=0.4, wander=0.4),
            Leg(((-1.7, 0.1), (-0.3, 0.6), (-0.3, 2.0)), "dining_table", speed=0.4),
        ),
    ),
    "apt_3_mnp": HomeTour("home_3", (0.0, 1.2, -1.5), _reach((0.28, -1.73), final_yaw=-math.pi / 2)),
}
"""By sequence name."""
