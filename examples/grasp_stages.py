"""The stages of taking an object that somebody points at: look closely, find a grasp in the map, reach, lift."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

import isdf
from examples.arm import Grasp, execute, open_hand, parked, plan_reach, reachable_grasps, within_limits
from examples.episode import Episode
from isdf.field import grid_points
from planning.clock import Clock
from planning.grasping import find_grasps
from planning.object_surface import object_surface
from planning.protocols import DistanceField
from robots.simulation import DepthFrame

GRIP_FORCE = 30.0
"""[N]"""
LIFTED, HELD_FOR = 0.10, 2.0
"""What counts as lifted [m], and for how long it is held [s]."""
CLOSE = isdf.MapperConfig(voxel=0.01, truncation=0.031)
"""The map of the object alone: fingers need it finer than wheels do."""
NEAR = 0.8
"""What is farther from the object than this [m] is left out of its map."""
SPACING = 0.03
"""Of the baked map that the arm plans in [m]."""
AROUND = 0.03
"""The robot has at least so much room about it where it stands [m]: it drove there."""
PLANS = 4
"""So many of the best grasps are planned to."""


def close_look(
    episode: Episode, point: np.ndarray, looks: int, clock: Clock, watch: Callable[[], None] = lambda: None
) -> DistanceField:
    """A fine map round a point [m], from images of a head that moves a little between them.

    The images go into the episode's map, too, and before them some of the space that the arm will move through.
    """
    mapper = isdf.Mapper(CLOSE)
    x, y, yaw = episode.robot.base_state()
    side = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    middle = (point + np.array([x, y, 0.3])) / 2
    before = [middle, *(shift * side + at for shift in (0.6, -0.6) for at in (middle, point))]
    for number in range(len(before) + looks):
        close = point + (0.0, 0.15, -0.15)[number % 3] * side
        episode.robot.look_at(before[number] if number < len(before) else close)
        episode.robot.wait(0.3)
        frame = episode.robot.observe()
        if frame is None or not frame.depth.any():
            continue
        near = only_near(frame, point)
        views = [(episode.mapper, frame), *([(mapper, near)] if near.depth.any() else [])]
        spent = sum(clock.charge(partial(taking.integrate, view))[1] for taking, view in views)
        episode.robot.wait(spent + clock.train(episode.mapper))
        watch()
    return mapper.field()


def only_near(frame: DepthFrame, point: np.ndarray) -> DepthFrame:
    """The image with only what lies near a point [m]."""
    valid = frame.depth > 0
    near = np.linalg.norm(frame.points() - point, axis=1) < NEAR
    depth = frame.depth.copy()
    depth[valid] = np.where(near, depth[valid], 0.0)
    return replace(frame, depth=depth)


def choose_grasp(
    episode: Episode, close: DistanceField, point: np.ndarray, margin: float, seed: int
) -> tuple[Grasp, torch.Tensor] | str:
    """The best grasp that the arm can get to, and the way there (n, dof); or why there is none.

    Args:
        episode: with its robot parked.
        close: the fine map.
        point: on the object [m].
        margin: clearance the arm keeps in the map where start and goal allow it [m].
        seed: of all that is random.
    """
    model, q = parked(episode.model, episode.robot.posture())
    q = within_limits(model, q)
    x, y, _ = episode.robot.base_state()
    heading = float(np.arctan2(point[1] - y, point[0] - x))
    surface = object_surface(close, torch.as_tensor(point, dtype=torch.float32), seed=seed)
    if surface is None:
        return "nothing stands at the point"
    grasps = find_grasps(close, surface, open_hand(model), heading, seed=seed)
    if len(grasps) == 0:
        return "no antipodal grasp with room for the hand"
    field = field_for_reaching(episode)
    reason = f"none of {len(grasps)} grasps is within the arm's reach"
    for number, grasp in enumerate(reachable_grasps(model, q, grasps, field, seed=seed)):
        if number == PLANS:
            break
        result = plan_reach(model, q, grasp.approach[0], field, margin, seed)
        if result.success:
            return grasp, result.trajectory.waypoints
        reason = f"no way to the grasp: {result.message or result.status.value}"
    return reason


def field_for_reaching(episode: Episode) -> DistanceField:
    """The map round the parked robot, baked finely, and free where the robot is, whatever the map guesses there."""
    x, y, _ = episode.robot.base_state()
    bounds = torch.tensor([[x - 1.1, y - 1.1, 0.0], [x + 1.1, y + 1.1, 1.6]])
    points = grid_points(bounds, SPACING)
    distance = episode.mapper.field().distance(points)
    centres, radii = own_space(episode)
    for block in torch.arange(len(points)).split(64):
        inside = (radii - torch.cdist(points[block].reshape(-1, 3), centres)).amax(dim=1) + AROUND
        inside = inside.view(distance[block].shape)
        distance[block] = torch.where(inside > 0, torch.maximum(distance[block], inside), distance[block])
    return isdf.GridField(distance, bounds[0], SPACING)


def own_space(episode: Episode) -> tuple[torch.Tensor, torch.Tensor]:
    """Balls (n, 3), (n,) [m] in which the robot is, or will be when its torso rises: its camera never sees them."""
    model = episode.model
    q = torch.as_tensor(episode.robot.posture(), dtype=torch.float32).repeat(5, 1)
    lift = model.joint_names.index("torso_lift_joint")
    q[1:, lift] = torch.linspace(float(q[0, lift]), float(model.joint_limits[lift, 1]), 4)
    centres, radii = model.spheres(q)
    rising = torch.tensor([link.startswith("torso") for link in model.sphere_links])
    risen = centres[1:, rising].reshape(-1, 3)
    return torch.cat([centres[0], risen]), torch.cat([radii, radii[rising].repeat(4)])


def take(
    episode: Episode,
    grasp: Grasp,
    reach: torch.Tensor,
    object_name: str,
    watch: Callable[[], None] = lambda: None,
) -> float:
    """Reach, approach, close, lift and hold; returns how high the object stayed over its place [m]."""
    robot = episode.robot
    model, _ = parked(episode.model, robot.posture())
    before = robot.world.object_pose(object_name)[2, 3]
    robot.world.command_gripper(1.0)
    for waypoints, speed in ((reach, 1.0), (grasp.approach, 0.4)):
        execute(robot, model, waypoints, speed)
        watch()
    robot.world.command_gripper(0.0, GRIP_FORCE)
    robot.wait(1.0)
    execute(robot, model, grasp.lift, 0.4)
    watch()
    heights = []
    for _ in range(round(HELD_FOR / 0.1)):
        robot.wait(0.1)
        heights.append(robot.world.object_pose(object_name)[2, 3] - before)
        watch()
    return float(min(heights))
