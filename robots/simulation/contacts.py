"""True contacts between the robot and the world, as the physics engine found them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import pybullet


@dataclass(frozen=True)
class Contact:
    """One link of the robot touching one body of the world.

    Attributes:
        link: name of the robot's link.
        body: name of the body it touches, or of the other link for a self-collision.
        depth: how far the two overlap at the deepest point [m], 0 for a mere touch.
        force: normal force [N], summed over all points where the two touch.
        position: world position of the deepest point on the body (x, y, z) [m].
    """

    link: str
    body: str
    depth: float
    force: float
    position: tuple[float, float, float]


def robot_contacts(
    client: int, robot: int, links: Mapping[int, str], bodies: Mapping[int, Mapping[int, str]]
) -> dict[tuple[str, str], Contact]:
    """One contact for each (link, body) pair that touched in the last physics step.

    Args:
        client: id of the pybullet client.
        robot: body id of the robot.
        links: the robot's link names by index.
        bodies: names of the other bodies' links by body id and link index.
    """
    found: dict[tuple[str, str], Contact] = {}
    for point in pybullet.getContactPoints(bodyA=robot, physicsClientId=client):
        other, distance = point[2], point[8]
        # Points with positive distance are only within the engine's margin, unless they already push.
        if distance > 0 and point[9] <= 0:
            continue
        link = links[point[3]]
        body = links[point[4]] if other == robot else bodies[other][point[4]]
        contact = Contact(link, body, max(0.0, -distance), point[9], tuple(point[6]))
        known = found.get((link, body))
        if known is not None:
            deeper = max(known, contact, key=lambda c: c.depth)
            contact = replace(deeper, force=known.force + contact.force)
        found[link, body] = contact
    return found
