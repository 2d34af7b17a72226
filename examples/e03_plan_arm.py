"""3. A depth camera maps a table; the Panda plans through the map from one side of a pillar to the other.

    python -m examples.e03_plan_arm --out runs/e03

The plan only knows the map. The exact field of the scene then tells how clear the plan really is. Leaves joints.png
and slice.png.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

import isdf
import planning
import robots
from robots.simulation import Box, DepthCamera, DepthNoise, Scene, World
from robots.simulation.poses import looking, planar_pose

TABLE = Box("table", planar_pose(0.75, 0.0, 0.06), (0.8, 1.4, 0.1))
PILLAR = Box("pillar", planar_pose(0.45, 0.0, 0.41), (0.1, 0.1, 0.6))
FLOOR = Box("floor", planar_pose(0.0, 0.0, -0.3), (5.0, 5.0, 0.1))


@dataclass(frozen=True)
class PlanArm:
    """Map a table with a pillar on it and plan the Panda round the pillar."""

    out: Path
    """Folder for the pictures."""
    views: int = 12
    """Depth images, from a half circle in front of the table."""
    margin: float = 0.02
    """Clearance in the map that a plan must keep [m]: about what the map errs by."""
    seed: int = 0
    """Of noise and search."""


def camera_pose(angle: float) -> np.ndarray:
    """T_world_camera (4, 4) of a camera 1.9 m from the pillar at an angle [rad], looking at it; OpenCV axes."""
    target = np.array([0.5, 0.0, 0.3])
    eye = target + np.array([1.9 * math.cos(angle), 1.9 * math.sin(angle), 0.7])
    return looking(eye, target - eye)


def mapped(world: World, options: PlanArm) -> isdf.Mapper:
    """Noisy images from a half circle, in a map."""
    mapper, noise, rng = isdf.Mapper(), DepthNoise(), np.random.default_rng(options.seed)
    for number, angle in enumerate(np.linspace(-2.6, 2.6, options.views)):
        frame = DepthCamera(world, T_link_camera=camera_pose(float(angle))).render()
        mapper.integrate(
            isdf.DepthFrame(noise(frame.depth, rng), frame.T_world_camera, frame.camera, float(number))
        )
    mapper.refresh()
    return mapper


def main(options: PlanArm) -> planning.PlanResult:
    """Map, plan, check against the truth; returns the plan."""
    torch.set_num_threads(1)
    with World(Scene("table", (TABLE, PILLAR, FLOOR))) as world:
        sdf, truth = mapped(world, options).field(), world.field()
    robot = robots.load("panda")
    low = robot.named["ready"].clone()
    low[1], low[3] = 0.0, -2.2  # the hand over the table
    start, goal = low.clone(), low.clone()
    start[0], goal[0] = -0.9, 0.9  # on the right of the pillar, then on its left

    validation = planning.ValidationConfig(margin=options.margin)
    config = planning.PlannerConfig(
        chomp=planning.ChompConfig(validation=validation),
        rrt=planning.RrtConfig(margin=options.margin + 0.005, min_margin=options.margin),
    )
    straight = planning.check(robot, planning.Trajectory.line(start, goal), sdf, validation)
    result = planning.Planner(robot, config, options.seed).plan(start, goal, sdf)
    timed = planning.retime(result.trajectory, robot.velocity_limits, 2 * robot.velocity_limits)
    really = planning.check(robot, timed, truth)
    print(f"straight line: {straight.status.value} ({straight.message})")
    print(f"plan: {result}")
    print(f"timed: {timed}")
    print(f"in the true scene: {really.status.value}, clearance {100 * really.clearance:.1f} cm")

    options.out.mkdir(parents=True, exist_ok=True)
    timed.plot(robot.joint_names).savefig(options.out / "joints.png")
    region = torch.tensor([[-1.0, -1.5, 0.0], [2.0, 1.5, 1.5]])
    sdf.plot_slice(0.4, bounds=region).savefig(options.out / "slice.png")
    return result


if __name__ == "__main__":
    chosen = tyro.cli(PlanArm, description=__doc__)
    outcome = main(chosen)
    raise SystemExit(0 if outcome.success else 1)
