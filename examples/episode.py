"""What both closed-loop examples share: a robot in a furnished scene that maps as it goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as option
from pathlib import Path

import numpy as np
import torch
import tyro

import isdf
import robots
from examples.disturbances import Disturbance, DisturbedRobot
from examples.live import Live, LiveOptions
from examples.maps import Method, TrueMap, mean_error, new_map
from isdf.mapping.field import LatticeField
from planning.clock import Clock, FixedClock, MeasuredClock
from planning.collision_monitor import CollisionMonitor, Spheres
from planning.protocols import DistanceField
from robots.simulation import (
    DepthNoise,
    DepthNoiseConfig,
    Scene,
    SimulatedMobileRobot,
    World,
    load_urdf_scene,
    make_scene,
)

# Range of the camera [m]; that of the Orbbec Astra on TIAGo's head. Where nothing is in range nothing is measured, and
# what has gone from there stays in the map.
CAMERA_RANGE = 8.0
# The robot is lower than this [m]: space above it need not be baked for planning a path of the base.
ROBOT_HEIGHT = 1.45


@dataclass(frozen=True)
class EpisodeOptions:
    """What every closed-loop example takes."""

    out: Path
    """Folder for the report and pictures."""
    scene: str = "apartment"
    """A furnished room (apartment, office, flat, home_1 to home_3) or the path of a .urdf scene."""
    seed: int = 0
    """Shifts the furniture, picks start and goal, and seeds map, noise and search."""
    noise: bool = True
    """Give the depth camera the noise of a real one."""
    method: Method = "default"
    """The map to drive by; `truth` knows the world beforehand."""
    fixed_cost: bool = False
    """Charge fixed times for computing instead of measured CPU time, so that runs repeat exactly."""
    live: tyro.conf.OmitArgPrefixes[LiveOptions] = option(default_factory=LiveOptions, kw_only=True)
    """Watching."""


class Episode:
    """A world with TIAGo in it, its map, and its body as the planner of its base sees it.

    Args:
        options: scene, seed and noise.
        start: base pose x, y [m], yaw [rad]; the scene's own if None.
        disturbances: what makes the episode harder.
        scene: instead of the one that the options name.
    """

    def __init__(
        self,
        options: EpisodeOptions,
        start: tuple[float, float, float] | None = None,
        disturbances: Sequence[Disturbance] = (),
        scene: Scene | None = None,
    ) -> None:
        self.options = options
        self.scene = scene or chosen_scene(options)
        start = start or self.scene.start
        if start is None:
            raise SystemExit(f"{options.scene} has no start of its own: give --start X Y YAW")
        self.model = robots.load("tiago")
        q = self.model.named["tucked"].double().numpy().copy()
        q[:3] = start
        self.world = World(self.scene)
        noise = DepthNoise(DepthNoiseConfig(max_range=CAMERA_RANGE)) if options.noise else None
        simulated = SimulatedMobileRobot(
            self.world, self.model, q, noise=noise, seed=options.seed, max_range=CAMERA_RANGE
        )
        self.body = robots.SweptBase(self.model, torch.as_tensor(q, dtype=torch.float32))
        self.mapper = new_map(options.method, options.seed, self.world)
        self.live = Live(options.live, self.model, self.world, self.mapper)
        self.robot = DisturbedRobot(simulated, [*disturbances, self.live])
        self.monitor = CollisionMonitor(self.spheres)

    def clock(self) -> Clock:
        """What computing costs the robot in time; watching it costs nothing."""
        return FixedClock() if self.options.fixed_cost else MeasuredClock(timer=self.live.timer)

    def spheres(self) -> Spheres:
        """The robot's spheres where they are now: centres (s, 3) and radii (s,) [m]."""
        centres, radii = self.model.spheres(torch.as_tensor(self.robot.posture(), dtype=torch.float32))
        return centres.double().numpy(), radii.double().numpy()

    def field_for_driving(self) -> DistanceField:
        """The map, baked up to the robot's height where its own queries are slow."""
        field = self.mapper.field()
        if isinstance(field, LatticeField):
            return field
        bounds = self.mapper.bounds
        bounds[0, 2], bounds[1, 2] = 0.0, ROBOT_HEIGHT
        return isdf.bake(field, bounds, 0.08, 0.1)

    def map_report(self) -> dict:
        """What a report says of the map: method, steps, and its error where the truth is known."""
        mapper = self.mapper
        known = bool(self.world.solids) and self.scene.urdf_path is None and mapper.frames_seen > 0
        error = mean_error(mapper.field(), self.world.field(), mapper.bounds) if known else None
        return {"method": self.options.method, "steps": mapper.steps, "sdf_error": error}

    def save_map(self, path: Path) -> None:
        """Write the map to a file; the ground truth has none."""
        if not isinstance(self.mapper, TrueMap):
            self.mapper.save(path)

    def contacts(self) -> dict[str, float]:
        """True contacts of the robot with the world so far, as "link - body": depth [m]."""
        return self.robot.recording.touched()

    def close(self) -> None:
        """Shut the simulator down, once nobody watches any more."""
        self.live.close()
        self.world.close()


def chosen_scene(options: EpisodeOptions) -> Scene:
    """The furnished room or URDF scene that the options name."""
    if options.scene.endswith(".urdf"):
        return load_urdf_scene(options.scene)
    return make_scene(options.scene, options.seed)


def outline_at(model: robots.Robot, q: np.ndarray, height: float) -> np.ndarray:
    """Centres and radii (n, 3) of the discs in which a level plane cuts the robot's spheres [m]."""
    centres, radii = model.spheres(torch.as_tensor(q, dtype=torch.float32))
    cut = (radii**2 - (centres[:, 2] - height) ** 2).clamp(min=0.0).sqrt()
    return np.column_stack([centres[:, :2].numpy(), cut.numpy()])[cut.numpy() > 0]


def base_outline(model: robots.Robot, q: np.ndarray) -> np.ndarray:
    """Centres and radii (s, 3) of the robot's spheres seen from above, to draw it [m]."""
    centres, radii = model.spheres(torch.as_tensor(q, dtype=torch.float32))
    return np.column_stack([centres[:, :2].numpy(), radii.numpy()])
