"""The stages of taking an object that somebody points at: look closely, find a grasp in the map, reach, lift."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float

import isdf
from examples.arm import (
    MOVED,
    Grasp,
    clearance,
    execute,
    open_hand,
    parked,
    plan_reach,
    reachable_grasps,
    within_limits,
)
from examples.episode import Episode
from isdf.field import grid_points
from planning.clock import Clock, FootprintMap
from planning.grasping import find_grasps
from planning.object_surface import object_surface
from planning.protocols import DistanceField
from robots.simulation import DepthFrame

LIFT = "torso_lift_joint"
GRIP_FORCE = 30.0
"""[N]"""
MET = 0.002
"""Fingers with less than this between them [m] have met."""
LIFTED, HELD_FOR = 0.10, 2.0
"""What counts as lifted [m], and for how long it is held [s]."""
CLOSE = isdf.MapperConfig(voxel=0.004, truncation=0.031, refresh_period=math.inf, guess_period=math.inf)
"""The map of the object alone: fingers need it finer than wheels do. It is read once, after all images."""
NEAR = 0.45
"""What is farther from the object than this [m] is left out of its map."""
HEIGHTS = 3
"""The torso rises so many times: from higher up more of the far sides is seen."""
GLANCES = ((0.0, 0.0), (0.12, -0.08), (-0.12, -0.08), (0.0, 0.1))
"""Where the camera looks in turn, sideways and up from the point [m]."""
APART = 0.05
"""Places nearer to each other than this [m] see the same."""
SPACING = 0.03
"""Of the baked map that the arm plans in [m]."""
AROUND = 0.03
"""The robot has at least so much room about it where it stands [m]: it drove there."""
STANDS = 0.08
"""And so much about what neither arm nor torso moves [m]: a reach is planned with the margin of the nearest part, and
that is to be one that moves."""
TORSO_STEPS = 12
"""Heights of the torso that stand for all."""
PLANS = 4
"""So many of the best grasps are planned to."""


class CloseLook:
    """A fine map round a point, and where its images were taken from; it grows with every place the robot looks from.

    Args:
        episode: whose own map takes in the images, too.
        point: on the object [m].
        clock: what computing costs.
        watch: called after every image.
    """

    def __init__(
        self, episode: Episode, point: np.ndarray, clock: Clock, watch: Callable[[], None] = lambda: None
    ) -> None:
        self.episode, self.point, self.clock, self.watch = episode, point, clock, watch
        self.mapper = isdf.Mapper(CLOSE)
        self._eyes: list[np.ndarray] = []

    @property
    def eyes(self) -> Float[torch.Tensor, "k 3"]:
        """Places of the camera [m] that saw the object, but for those that hardly differ."""
        return torch.as_tensor(np.array(self._eyes).reshape(-1, 3), dtype=torch.float32)

    def look(self, looks: int) -> None:
        """Take images, first of the space that the arm will move through, then of the object while the torso rises."""
        x, y, yaw = self.episode.robot.base_state()
        side = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        middle = (self.point + np.array([x, y, 0.3])) / 2
        for at in (middle, *(shift * side + at for shift in (0.6, -0.6) for at in (middle, self.point))):
            self._take(at)
        for number, height in enumerate(heights_to_look_from(self.episode)):
            if number:
                raise_torso(self.episode, height)
            for glance in range(-(-looks // HEIGHTS)):
                beside, above = GLANCES[glance % len(GLANCES)]
                self._take(self.point + beside * side + (0.0, 0.0, above))
        self.mapper.refresh()

    def _take(self, at: np.ndarray) -> None:
        """An image of what is at a place [m]."""
        robot, mapper = self.episode.robot, self.episode.mapper
        robot.look_at(at)
        robot.wait(0.3)
        frame = robot.observe()
        if frame is None or not frame.depth.any():
            return
        if isinstance(mapper, FootprintMap):
            mapper.clear_footprint(*self.episode.spheres())
        near = only_near(frame, self.point)
        views = [(mapper, frame), *([(self.mapper, near)] if near.depth.any() else [])]
        spent = sum(self.clock.charge(partial(taking.integrate, view))[1] for taking, view in views)
        eye = frame.T_world_camera[:3, 3]
        if len(views) > 1 and all(np.linalg.norm(eye - other) > APART for other in self._eyes):
            self._eyes.append(eye)
        robot.wait(spent + self.clock.train(mapper))
        self.watch()


def heights_to_look_from(episode: Episode) -> list[float]:
    """Positions of the torso [m], from where it is upwards as far as the robot keeps clear in its map."""
    model, q = parked(episode.model, episode.robot.posture())
    lift = model.joint_names.index(LIFT)
    postures = q.repeat(8, 1)
    postures[:, lift] = torch.linspace(float(q[lift]), float(model.joint_limits[lift, 1]), 8)
    field, free = episode.mapper.field(), 1
    room = min(AROUND, clearance(model, postures[:1], field))
    while free < len(postures) and clearance(model, postures[free : free + 1], field) >= room:
        free += 1
    return torch.linspace(float(q[lift]), float(postures[free - 1, lift]), HEIGHTS).tolist()


def raise_torso(episode: Episode, height: float) -> None:
    """Move the torso to a position [m], the arm as it is."""
    model, q = parked(episode.model, episode.robot.posture())
    q = within_limits(model, q)
    goal = q.clone()
    goal[model.joint_names.index(LIFT)] = height
    execute(episode.robot, model, torch.stack([q, within_limits(model, goal)]))


def only_near(frame: DepthFrame, point: np.ndarray) -> DepthFrame:
    """The image with only what lies near a point [m]."""
    valid = frame.depth > 0
    near = np.linalg.norm(frame.points() - point, axis=1) < NEAR
    depth = frame.depth.copy()
    depth[valid] = np.where(near, depth[valid], 0.0)
    return replace(frame, depth=depth)


def choose_grasp(
    episode: Episode, close: CloseLook, margin: float, seed: int
) -> tuple[Grasp, torch.Tensor] | str:
    """The best grasp that the arm can get to, and the way there (n, dof); or why there is none.

    Args:
        episode: with its robot parked.
        close: what was seen of the object.
        margin: clearance the arm keeps in the map where start and goal allow it [m].
        seed: of all that is random.
    """
    model, q = parked(episode.model, episode.robot.posture())
    q = within_limits(model, q)
    x, y, _ = episode.robot.base_state()
    point, map_of_it = torch.as_tensor(close.point, dtype=torch.float32), close.mapper.field()
    heading = float(torch.atan2(point[1] - y, point[0] - x))
    surface = object_surface(map_of_it, point, close.eyes, seed=seed)
    if surface is None:
        return "nothing stands at the point"
    grasps = find_grasps(map_of_it, surface, open_hand(model), heading, seed=seed)
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
        inside = (radii - torch.cdist(points[block].reshape(-1, 3), centres)).amax(dim=1)
        inside = inside.view(distance[block].shape)
        distance[block] = torch.where(inside > 0, torch.maximum(distance[block], inside), distance[block])
    return isdf.GridField(distance, bounds[0], SPACING)


def own_space(episode: Episode) -> tuple[torch.Tensor, torch.Tensor]:
    """Balls (n, 3), (n,) [m] that are free: round the robot, and round its torso when it rises or sinks.

    Its camera sees none of that.
    """
    model = episode.model
    q = torch.as_tensor(episode.robot.posture(), dtype=torch.float32).repeat(1 + TORSO_STEPS, 1)
    lift = model.joint_names.index(LIFT)
    q[1:, lift] = torch.linspace(*model.joint_limits[lift].tolist(), TORSO_STEPS)
    centres, radii = model.spheres(q)
    risen = (centres - centres[0]).norm(dim=-1).amax(dim=0) > MOVED
    radii = radii + torch.where(risen, AROUND, STANDS)
    rising = torch.tensor([link.startswith("torso") for link in model.sphere_links]) & risen
    higher = centres[1:, rising].reshape(-1, 3)
    return torch.cat([centres[0], higher]), torch.cat([radii, radii[rising].repeat(TORSO_STEPS)])


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


def holds_nothing(episode: Episode) -> bool:
    """Whether the fingers have met; this the robot feels itself."""
    gripper = episode.model.gripper
    assert gripper is not None
    gaps = [
        episode.robot.world.robot.joint_position(name) - closed
        for name, closed in zip(gripper.joint_names, gripper.closed_position, strict=True)
    ]
    return sum(gaps) < MET


def draw_back(episode: Episode, tucked: np.ndarray, margin: float, seed: int) -> bool:
    """Open the empty hand and move the arm back to where it was, posture (dof,), through the map."""
    robot = episode.robot
    robot.world.command_gripper(1.0)
    robot.wait(1.0)
    model, q = parked(episode.model, robot.posture())
    _, goal = parked(episode.model, tucked)
    q, goal = within_limits(model, q), within_limits(model, goal)
    result = plan_reach(model, q, goal, field_for_reaching(episode), margin, seed)
    if result.success:
        execute(robot, model, result.trajectory.waypoints)
    return result.success
