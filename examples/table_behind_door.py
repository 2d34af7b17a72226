"""A table behind a doorway: the place, a map of it, and postures that bring a hand over the table."""

from __future__ import annotations

import math

import numpy as np
import torch

import isdf
import planning
import robots
from examples.maps import Method, new_map
from robots.inverse_kinematics import solve
from robots.simulation import Box, DepthCamera, DepthNoise, Scene, World
from robots.simulation.poses import looking, planar_pose

WHITE, WOOD, GREY = (0.9, 0.88, 0.84), (0.7, 0.5, 0.3), (0.55, 0.55, 0.58)
WALLS = tuple(
    Box(f"wall_{side}", planar_pose(1.5, side * 1.75, 1.0), (0.1, 2.5, 2.0), colour=WHITE) for side in (-1, 1)
)
TABLE = Box("table", planar_pose(4.0, 0.6, 0.72), (0.8, 1.4, 0.05), colour=WOOD)
LEGS = tuple(
    Box(f"leg_{x}_{y}", planar_pose(4 + 0.3 * x, 0.6 + 0.6 * y, 0.35), (0.06, 0.06, 0.7), colour=WOOD)
    for x in (-1, 1)
    for y in (-1, 1)
)
FLOOR = Box("floor", planar_pose(2.5, 0.0, -0.05), (14.0, 12.0, 0.1), colour=GREY)
PLACE = Scene("table behind a door", (FLOOR, *WALLS, TABLE, *LEGS))
TARGET = torch.tensor([4.25, 0.75, 1.0])  # of the hand, which points down [m]
REGION = torch.tensor([[-1.5, -2.5, -0.2], [6.5, 3.5, 1.8]])  # [m]
EYES = ((0.0, 0.0), (0.0, 1.5), (0.0, -1.5), (2.4, -0.9), (2.4, 2.1), (5.4, 0.6), (4.0, -1.2), (4.0, 2.4))


def mapped(world: World, method: Method, seed: int) -> planning.DistanceField:
    """A map of noisy images taken all round from several places, 1.4 m high."""
    mapper = new_map(method, seed, world)
    noise, rng = DepthNoise(), np.random.default_rng(seed)
    for number, (x, y) in enumerate(EYES):
        for yaw in np.arange(8) * math.pi / 4:
            T = looking((x, y, 1.4), (math.cos(yaw), math.sin(yaw), -0.4))
            frame = DepthCamera(world, T_link_camera=T).render()
            depth = noise(frame.depth, rng)
            mapper.integrate(isdf.DepthFrame(depth, frame.T_world_camera, frame.camera, number + yaw / 10))
    if isinstance(mapper, isdf.Mapper):
        mapper.refresh()
    mapper.run_for(20.0)
    return mapper.field()


def reaching(
    robot: robots.Robot, sdf: planning.DistanceField, config: planning.ValidationConfig
) -> torch.Tensor:
    """Free postures (g, dof) with the hand at the target, the robot on any side of the table."""
    pose, angle = torch.eye(4), torch.arange(12) / 12 * 2 * math.pi
    pose[:3, :3], pose[:3, 3] = torch.diag(torch.tensor([1.0, -1.0, -1.0])), TARGET
    seeds = robot.named["ready"].repeat(12, 1)
    seeds[:, 0], seeds[:, 1], seeds[:, 2] = TARGET[0] - angle.cos(), TARGET[1] - angle.sin(), angle
    found = solve(robot, pose.expand(12, 4, 4), seeds, free_axis=2, num_seeds=4)
    stays = [planning.Trajectory(q[None], torch.zeros(1)) for q in found.q[found.converged]]
    free = [stay.waypoints[0] for stay in stays if planning.check(robot, stay, sdf, config).success]
    if not free:
        raise SystemExit("no free posture brings the hand to the target")
    return torch.stack(free)
