"""Contacts of a recorded episode, found anew: its states are put into a fresh world and measured there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pybullet

import robots
from examples.disturbances import People
from robots.simulation import Cylinder, Scene, World
from robots.simulation.poses import planar_pose

TOUCH = 0.0005
"""Bodies that overlap by less than this [m] only touch in passing: the physics' own tolerance."""

AWAY = planar_pose(0.0, 0.0, 50.0)
"""Where a solid waits that is not in the world yet."""


def recheck(scene: Scene, states: Path, every: int = 1, watched: str | None = None) -> dict[str, float]:
    """Deepest overlap [m] of each pair "link - body" over the recorded states.

    Args:
        scene: the one that the episode ran in.
        states: its states.npz.
        every: looks at one state in so many.
        watched: name of a solid whose overlaps with other bodies count as well, as "watched - body".
    """
    with np.load(states) as saved:
        data = {key: saved[key] for key in saved.files}
    model = robots.load("tiago")
    deepest: dict[str, float] = {}
    with World(scene) as world:
        robot = world.add_robot(
            model.urdf_path, model.joint_names, data["joint_positions"][0], gripper=model.gripper
        )
        names = [str(name) for name in data["object_names"]]
        for name in names:
            if name not in world.solids:  # a person, who came with the episode
                world.add_body(Cylinder(name, AWAY, People.RADIUS, People.HEIGHT))
        for index in range(0, len(data["time"]), every):
            robot.reset(data["joint_positions"][index])
            for name, pose in zip(names, data["object_poses"][index], strict=True):
                world.set_object_pose(name, AWAY if np.isnan(pose).any() else pose)
            pybullet.performCollisionDetection(physicsClientId=world.client)
            found = _overlaps(world, world.robot.body, world.robot.link_names)
            if watched is not None:
                body = world.body_id(watched)
                found |= _overlaps(world, body, {-1: watched}, other_than=world.robot.body)
            for pair, depth in found.items():
                deepest[pair] = max(deepest.get(pair, 0.0), depth)
    return deepest


def _overlaps(
    world: World, body: int, names: Mapping[int, str], other_than: int | None = None
) -> dict[str, float]:
    """Of a body, whose links have names, with all bodies but itself and perhaps another."""
    found: dict[str, float] = {}
    for point in pybullet.getContactPoints(bodyA=body, physicsClientId=world.client):
        if point[2] in (body, other_than) or -point[8] <= TOUCH:
            continue
        pair = f"{names[point[3]]} - {world.name_of(point[2], point[4])}"
        found[pair] = max(found.get(pair, 0.0), float(-point[8]))
    return found
