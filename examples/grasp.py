"""A mobile manipulator drives up to a table, maps it, reaches through the map, and lifts an object off it.

    python -m examples.grasp --out runs/grasp --scene apartment --seed 0

The object's place is given, as a detector would; the room is not. Leaves report.html, report.json, states.npz (every
executed step), map.png, map.safetensors and episode.gif. Success is read from the physics: lifted 10 cm, held for 2 s.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm import tqdm

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import isdf
from examples.arm import Grasp, execute, grasp_candidates, parked, plan_reach, within_limits
from examples.episode import Episode, EpisodeOptions, chosen_scene
from examples.pictures import Film, save_map_picture
from examples.report import write_report
from planning.drive import DriveReport
from planning.replanning import ReplanningConfig, ReplanningLoop
from robots.simulation import GraspTask, Scene, SceneField

LIFTED, HELD_FOR = 0.10, 2.0
GRIP_FORCE = 20.0
# Above the middle of the object [m], so that the hand stays clear of the table.
GRIP_HEIGHT = 0.025


@dataclass(frozen=True)
class GraspOptions(EpisodeOptions):
    """Approach a table, map it, and lift an object off it."""

    distance: float = 1.6
    """How far from its parking place the robot starts, about [m]."""
    margin: float = 0.02
    """Clearance the arm keeps in the map where start and goal allow it [m]."""
    film: bool = True
    """Make the GIF; it takes about half a minute."""


class GraspEpisode:
    """The stages of one episode; `run` goes through them and says where it ended."""

    def __init__(self, options: GraspOptions) -> None:
        self.options = options
        scene = chosen_scene(options)
        if scene.grasp is None:
            raise SystemExit(f"{options.scene} has no object to grasp; choose apartment, office or flat")
        self.task: GraspTask = scene.grasp
        self.episode = Episode(options, start_before(scene, self.task, options.distance, options.seed))
        self.clock = options.clock()
        self.drive: DriveReport | None = None
        self.planning_seconds = 0.0
        self.lift_height = 0.0
        self.film = Film(self.episode, np.array(self.task.park), 0.7 if options.film else np.inf)
        self.bar = tqdm(desc="approaching", unit=" s", disable=None, bar_format="{desc}: {elapsed}")

    def run(self) -> str:
        """Returns "success" or the stage that failed."""
        if not self.approach():
            return "approach"
        self.bar.set_description("mapping the table")
        self.film.close_up = self.episode.world.object_pose(self.task.object_name)[:3, 3]
        self.map_table()
        self.bar.set_description("planning the reach")
        grasp, reach = self.plan()
        if grasp is None or reach is None:
            return "planning"
        self.bar.set_description("grasping")
        self.take(grasp, reach)
        return "success" if self.lift_height >= LIFTED else "lift"

    def approach(self) -> bool:
        """Drive to the parking place, turned to the table."""
        episode = self.episode
        loop = ReplanningLoop(
            episode.robot,
            episode.body,
            episode.mapper,
            episode.field_for_driving,
            ReplanningConfig(scan=2 * math.pi, time_limit=120.0),
            self.clock,
            lambda loop: self.film.add(None if loop.plan is None else loop.plan.trajectory.waypoints.numpy()),
            self.options.seed,
            episode.monitor,
        )
        self.drive = loop.drive_to(np.array(self.task.park[:2]), final_yaw=self.task.park[2])
        return self.drive.success

    def map_table(self, seconds: float = 8.0) -> None:
        """Look over the table and its object while the map trains, for about so long [s of the robot's time]."""
        episode, middle = self.episode, self.episode.world.object_pose(self.task.object_name)[:3, 3]
        side = np.array([-np.sin(self.task.park[2]), np.cos(self.task.park[2]), 0.0])
        ends = episode.robot.time + seconds
        offsets = (0.0, 0.3, -0.3, 0.0, 0.5, -0.5)
        turn = 0
        while episode.robot.time < ends:
            episode.robot.look_at(middle + offsets[turn % len(offsets)] * side)
            turn += 1
            episode.robot.wait(0.3)
            episode.mapper.integrate(episode.robot.observe())
            episode.robot.wait(self.clock.train(episode.mapper) + self.clock.train(episode.mapper))
            self.film.add()

    def plan(self) -> tuple[Grasp | None, torch.Tensor | None]:
        """Choose a grasp and plan the way to where its straight approach begins."""
        episode = self.episode
        model, q = parked(episode.model, episode.robot.posture())
        q = within_limits(model, q)
        middle = episode.world.object_pose(self.task.object_name)[:3, 3]

        def search() -> tuple[Grasp | None, torch.Tensor | None]:
            field = self.field_for_reaching()
            yaw = float(episode.robot.base_state()[2])
            target = middle + np.array([0.0, 0.0, GRIP_HEIGHT])
            for grasp in grasp_candidates(model, q, target, yaw, field, seed=self.options.seed)[:4]:
                result = plan_reach(
                    model, q, grasp.approach[0], field, self.options.margin, self.options.seed
                )
                if result.success:
                    return grasp, result.trajectory.waypoints
            return None, None

        found, spent = self.clock.charge(search)
        self.planning_seconds = spent
        episode.robot.wait(spent)
        return found

    def field_for_reaching(self):
        """The map round the robot and the table, baked finely."""
        x, y, _ = self.episode.robot.base_state()
        bounds = torch.tensor([[x - 1.1, y - 1.1, 0.0], [x + 1.1, y + 1.1, 1.6]])
        return isdf.bake(self.episode.mapper.field(), bounds, 0.03)

    def take(self, grasp: Grasp, reach: torch.Tensor) -> None:
        """Reach, approach, close, lift and hold."""
        robot = self.episode.robot
        model, _ = parked(self.episode.model, robot.posture())
        before = robot.world.object_pose(self.task.object_name)[2, 3]
        robot.world.command_gripper(1.0)
        for waypoints, speed in ((reach, 1.0), (grasp.approach, 0.4)):
            execute(robot, model, waypoints, speed)
            self.film.add()
        robot.world.command_gripper(0.0, GRIP_FORCE)
        robot.wait(1.0)
        execute(robot, model, grasp.lift, 0.4)
        self.film.add()
        heights = []
        for _ in range(round(HELD_FOR / 0.1)):
            robot.wait(0.1)
            heights.append(robot.world.object_pose(self.task.object_name)[2, 3] - before)
            self.film.add()
        self.lift_height = float(min(heights))


def start_before(scene: Scene, task: GraspTask, distance: float, seed: int) -> tuple[float, float, float]:
    """A free base pose about `distance` [m] from the parking place, turned any way."""
    rng = np.random.default_rng([seed, 77])
    field = SceneField(scene)
    width, length, _ = scene.size or (math.inf, math.inf, 0.0)
    best, most = task.park, -math.inf
    for _ in range(400):
        angle, reach = rng.uniform(-math.pi, math.pi), rng.uniform(0.8, 1.2) * distance
        x, y = task.park[0] + reach * math.cos(angle), task.park[1] + reach * math.sin(angle)
        if max(abs(x) / width, abs(y) / length) > 0.5:
            continue  # outside of the room it is free, too
        column = torch.tensor([[x, y, z] for z in np.arange(0.55, 1.3, 0.15)], dtype=torch.float32)
        room = float(field.distance(column).min())
        if room > 0.55:
            return x, y, float(rng.uniform(-math.pi, math.pi))
        if room > most:
            best, most = (x, y, float(rng.uniform(-math.pi, math.pi))), room
    return best


def main(options: GraspOptions) -> dict:
    """Run one episode and write its results; returns the report."""
    torch.set_num_threads(1)
    started = time.perf_counter()
    grasping = GraspEpisode(options)
    ended = grasping.run()
    grasping.bar.close()
    episode, drive = grasping.episode, grasping.drive
    contacts = episode.robot.recording.touched(ignore=(grasping.task.object_name,))
    assert drive is not None
    report = {
        "example": "grasp",
        "scene": options.scene,
        "seed": options.seed,
        "success": ended == "success",
        "ended": ended,
        "lift_height": grasping.lift_height,
        "held_seconds": HELD_FOR if ended == "success" else 0.0,
        "contacts": len(contacts),
        "contact_pairs": contacts,
        "drive": dataclasses.asdict(drive) | {"status": drive.status.value},
        "planning_seconds": grasping.planning_seconds,
        "map": episode.map_report(),
        "robot_seconds": episode.robot.time,
        "wall_seconds": time.perf_counter() - started,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    episode.robot.recording.save(options.out / "states.npz")
    episode.save_map(options.out / "map.safetensors")
    save_map_picture(options.out / "map.png", episode, np.array(grasping.task.park))
    if options.film:
        grasping.film.save(options.out / "episode.gif")
    write_report(options.out, report, headline(report))
    episode.close()
    return report


def headline(report: dict) -> str:
    """What happened, in a line."""
    if report["success"]:
        verdict = f"Lifted the object {100 * report['lift_height']:.0f} cm and held it {report['held_seconds']:.0f} s"
    else:
        verdict = f"Failed at: {report['ended']}"
    return f"{verdict}, {report['contacts']} contacts with anything else, {report['robot_seconds']:.0f} s in all."


if __name__ == "__main__":
    options = tyro.cli(GraspOptions)
    outcome = main(options)
    print(headline(outcome))
    print(f"report: {options.out / 'report.html'}")
