"""What both closed-loop examples share: a robot in a furnished scene that maps as it goes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import isdf
import robots
from planning.clock import Clock, FixedClock, MeasuredClock
from planning.protocols import DistanceField
from robots.simulation import DepthNoise, Scene, SimulatedMobileRobot, World, load_urdf_scene, make_scene

# Robots are shorter than this [m]: space above it need not be baked for planning a path of the base.
ROBOT_HEIGHT = 1.45


@dataclass(frozen=True)
class EpisodeOptions:
    """What every closed-loop example takes."""

    out: Path
    """Folder for the report and pictures."""
    scene: str = "apartment"
    """A furnished room (apartment, office, flat) or the path of a .urdf scene."""
    seed: int = 0
    """Shifts the furniture, picks start and goal, and seeds map, noise and search."""
    noise: bool = True
    """Give the depth camera the noise of a real one."""
    fixed_cost: bool = False
    """Charge fixed times for computing instead of measured CPU time, so that runs repeat exactly."""

    def clock(self) -> Clock:
        """What computing costs the robot in time."""
        return FixedClock() if self.fixed_cost else MeasuredClock()


class Episode:
    """A world with TIAGo in it, its map, and its body as the planner of its base sees it.

    Args:
        options: scene, seed and noise.
        start: base pose x, y [m], yaw [rad]; the scene's own if None.
    """

    def __init__(self, options: EpisodeOptions, start: tuple[float, float, float] | None = None) -> None:
        self.options = options
        self.scene = chosen_scene(options)
        start = start or self.scene.start
        if start is None:
            raise SystemExit(f"{options.scene} has no start of its own: give --start X Y YAW")
        self.model = robots.load("tiago")
        q = self.model.named["tucked"].double().numpy().copy()
        q[:3] = start
        self.world = World(self.scene)
        noise = DepthNoise() if options.noise else None
        self.robot = SimulatedMobileRobot(self.world, self.model, q, noise=noise, seed=options.seed)
        self.body = robots.SweptBase(self.model, torch.as_tensor(q, dtype=torch.float32))
        # The loop decides when to train, so taking in a frame does not.
        untimed = {"first_frame_steps": 0, "steps_per_frame": 0, "keyframe_steps": 0}
        self.mapper = isdf.IsdfMapper(replace(isdf.IsdfConfig(seed=options.seed), **untimed))

    def field_for_driving(self) -> DistanceField:
        """The map up to the robot's height, baked for fast queries."""
        bounds = self.mapper.bounds
        bounds[0, 2], bounds[1, 2] = 0.0, ROBOT_HEIGHT
        return self.mapper.field().bake(0.08, bounds, padding=0.1)

    def contacts(self) -> dict[str, float]:
        """True contacts of the robot with the world so far, as "link - body": depth [m]."""
        return self.robot.recording.touched()

    def close(self) -> None:
        """Shut the simulator down."""
        self.world.close()


def chosen_scene(options: EpisodeOptions) -> Scene:
    """The furnished room or URDF scene that the options name."""
    if options.scene.endswith(".urdf"):
        return load_urdf_scene(options.scene)
    return make_scene(options.scene, options.seed)


def base_outline(model: robots.Robot, q: np.ndarray) -> np.ndarray:
    """Centres and radii (s, 3) of the robot's spheres seen from above, to draw it [m]."""
    centres, radii = model.spheres(torch.as_tensor(q, dtype=torch.float32))
    return np.column_stack([centres[:, :2].numpy(), radii.numpy()])
