"""10. Base and arm together: through a doorway and round a table to a pose above it, on two wheels.

    python -m examples.e10_whole_body --out runs/e10

A depth camera maps the place first (`--method truth` plans in the exact field). CHOMP's plan slides the base sideways;
refining makes a motion of it that wheels can follow, within the limits of all joints. The simulated robot then carries
it out. Leaves joints.png, way.png and strip.png.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import isdf
import planning
import robots
from examples.maps import Method
from examples.pictures import photo_from
from examples.table_behind_door import PLACE, REGION, TARGET, mapped, reaching
from planning.refine import RefineConfig, Refiner
from planning.unicycle_mpc import UnicycleMpc
from robots.simulation import Recording, World

PERIOD, HORIZON = 0.1, 12


@dataclass(frozen=True)
class WholeBody:
    """Drive and reach at once, in a mapped or in a known place."""

    out: Path
    """Folder for the pictures."""
    method: Method = "default"
    """The map to plan in; `truth` knows the world beforehand."""
    margin: float = 0.03
    """Clearance in the map that the motion keeps [m]: more than what the map errs by."""
    seed: int = 0
    """Of noise, map, goals and search."""


def carried_out(
    world: World, robot: robots.Robot, motion: planning.Trajectory
) -> tuple[Recording, list[np.ndarray]]:
    """Wheels and joints follow the motion in physics; returns what happened, and photos of it."""
    wheels = UnicycleMpc(HORIZON, PERIOD, (-0.4, -1.2), (0.7, 1.2), (1.0, 2.0))
    world.add_robot(robot.urdf_path, robot.joint_names, motion.waypoints[0].numpy())
    recording, command, photos = Recording(world), np.zeros(2), list[np.ndarray]()
    times = np.arange(0.0, motion.duration + 1.0, PERIOD)
    for i, t in enumerate(times):
        ahead = motion.at(float(t) + PERIOD * torch.arange(HORIZON + 1)).numpy()
        solved = wheels.solve(world.robot_state()[0][:3], command, ahead[1:, :3].T)
        command = np.zeros(2) if solved is None else solved
        world.command_base(*command)
        world.command_joints(ahead[1], (ahead[1] - ahead[0]) / PERIOD)
        world.step(PERIOD)
        recording.add()
        if 3 * i >= len(photos) * (len(times) - 1):
            photos.append(photo_from(world, np.array([2.2, -3.8, 3.4]), np.array([2.4, 0.2, 0.5]), 400, 300))
    return recording, photos


def main(options: WholeBody) -> bool:
    """Map, plan, refine, carry out; returns whether the hand arrived and nothing was touched."""
    torch.set_num_threads(1)
    robot = robots.load("tiago")
    start, validation = robot.named["tucked"], planning.ValidationConfig(margin=options.margin)
    with World(PLACE) as world:
        sdf = mapped(world, options.method, options.seed)
        search = planning.RrtConfig(margin=options.margin + 0.005, min_margin=options.margin)
        config = planning.PlannerConfig(chomp=planning.ChompConfig(validation=validation), rrt=search)
        plan = planning.Planner(robot, config, options.seed).plan(
            start, reaching(robot, sdf, validation), sdf
        )
        print(f"plan: {plan}")
        if not plan.success:
            print(plan.message)
            return False
        accelerations = torch.tensor([0.6, 0.6, 1.5] + [2.0] * (robot.num_dofs - 3))
        refine = RefineConfig(margin=options.margin + 0.01, validation=validation)
        motion = Refiner(robot, accelerations, refine).refine(plan.trajectory, sdf)
        print(f"on wheels: {motion}")
        if not motion.success:
            print(motion.message)
            return False
        recording, photos = carried_out(world, robot, motion.trajectory)
        last = torch.as_tensor(world.robot_state()[0], dtype=torch.float32)
        truth, touched = world.field(), recording.touched()
    hand = robot.link_poses(last, [robot.tool_link])[0, :3, 3]
    error = float((hand - TARGET).norm())
    really = planning.check(robot, motion.trajectory, truth)
    print(f"in the true scene: {really.status.value}, clearance {100 * really.clearance:.1f} cm")
    print(f"carried out: contacts {touched or 'none'}, the hand is {1000 * error:.0f} mm from the target")

    options.out.mkdir(parents=True, exist_ok=True)
    motion.trajectory.plot(robot.joint_names).savefig(options.out / "joints.png")
    figure = isdf.plot_slice(sdf, 0.73, bounds=REGION)
    for path, colour in ((plan.trajectory.waypoints.numpy(), "green"), (recording.base_poses(), "red")):
        figure.axes[0].plot(path[:, 0], path[:, 1], color=colour)
    figure.axes[0].plot(*TARGET[:2].tolist(), "*", color="gold", markersize=14, markeredgecolor="black")
    figure.savefig(options.out / "way.png")
    Image.fromarray(np.concatenate(photos, axis=1)).save(options.out / "strip.png")
    return error < 0.03 and not touched


if __name__ == "__main__":
    raise SystemExit(0 if main(tyro.cli(WholeBody, description=__doc__)) else 1)
