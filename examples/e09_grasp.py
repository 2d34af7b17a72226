"""9. Reach through a map: parked before a table, look it over, choose a grasp, plan to it, lift.

    python -m examples.e09_grasp --out runs/e09 --scene flat --seed 0

The object's place is given, as a detector would; the table is not. Leaves slice.png. `examples.grasp` also drives up to
the table, and writes a report.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import isdf
from examples.arm import Grasp, execute, grasp_candidates, parked, plan_reach, within_limits
from examples.episode import Episode, EpisodeOptions, chosen_scene
from planning.protocols import DistanceField

GRIP_FORCE = 20.0  # [N]
GRIP_HEIGHT = 0.025  # above the middle of the object [m], so that the hand stays clear of the table


@dataclass(frozen=True)
class LiftObject(EpisodeOptions):
    """Map a table and lift an object off it."""

    scene: str = "flat"
    """A furnished room with a grasp task: apartment, office or flat."""
    looks: int = 12
    """Depth images of the table."""
    margin: float = 0.02
    """Clearance the arm keeps in the map where start and goal allow it [m]."""


def look_over(episode: Episode, middle: np.ndarray, yaw: float, looks: int) -> DistanceField:
    """A map of the table: the head looks at the object and to both sides of it."""
    mapper, side = episode.mapper, np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    for number in range(looks):
        episode.robot.look_at(middle + (0.0, 0.3, -0.3)[number % 3] * side)
        episode.robot.wait(0.4)
        mapper.integrate(episode.robot.observe())
        mapper.run_for(0.4)  # what trains, trains; the others bring their distances up to date
    return mapper.field()


def choose(
    episode: Episode, field: DistanceField, middle: np.ndarray, options: LiftObject
) -> tuple[Grasp, torch.Tensor] | None:
    """The first grasp that a collision-free reach leads to, and that reach."""
    model, q = parked(episode.model, episode.robot.posture())
    q, yaw = within_limits(model, q), float(episode.robot.base_state()[2])
    target = middle + np.array([0.0, 0.0, GRIP_HEIGHT])
    for grasp in grasp_candidates(model, q, target, yaw, field, seed=options.seed)[:4]:
        result = plan_reach(model, q, grasp.approach[0], field, options.margin, options.seed)
        print(f"grasp with {100 * grasp.clearance:.1f} cm before it: {result}")
        if result.success:
            return grasp, result.trajectory.waypoints
    return None


def main(options: LiftObject) -> float:
    """Look, choose, take; returns by how much the object was lifted [m]."""
    torch.set_num_threads(1)
    task = chosen_scene(options).grasp
    if task is None:
        raise SystemExit(f"{options.scene} has no object to grasp; choose apartment, office or flat")
    episode = Episode(dataclasses.replace(options), task.park)
    robot, world = episode.robot, episode.world
    middle = world.object_pose(task.object_name)[:3, 3].copy()
    field = look_over(episode, middle, task.park[2], options.looks)
    options.out.mkdir(parents=True, exist_ok=True)
    around = torch.as_tensor(np.stack([middle - 1.0, middle + 1.0]), dtype=torch.float32)
    isdf.plot_slice(field, float(middle[2]), bounds=around).savefig(options.out / "slice.png")

    chosen = choose(episode, field, middle, options)
    if chosen is None:
        print("no grasp that can be reached")
        return 0.0
    grasp, reach = chosen
    model, _ = parked(episode.model, robot.posture())
    world.command_gripper(1.0)
    execute(robot, model, reach)
    execute(robot, model, grasp.approach, 0.4)
    world.command_gripper(0.0, GRIP_FORCE)
    robot.wait(1.0)
    execute(robot, model, grasp.lift, 0.4)
    lifted = float(world.object_pose(task.object_name)[2, 3] - middle[2])
    touched = robot.recording.touched(ignore=(task.object_name,))
    print(f"lifted {100 * lifted:.0f} cm; contacts with anything else: {touched or 'none'}")
    episode.close()
    return lifted


if __name__ == "__main__":
    raise SystemExit(0 if main(tyro.cli(LiftObject, description=__doc__)) > 0.1 else 1)
