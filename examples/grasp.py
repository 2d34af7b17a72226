"""A mobile manipulator drives up to an object that somebody points at, maps it, and lifts it off its table.

    python -m examples.grasp --out runs/grasp --scene apartment --seed 0

Given is a point on the object, as a click in the camera's image gives it; neither its shape and pose nor the room is.
Leaves report.html, report.json, summary.png, states.npz (every executed step), map.png, map.safetensors and
episode.gif. Success is read from the physics: lifted 10 cm, held for 2 s.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm import tqdm

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from examples.arm import Grasp, parked
from examples.episode import Episode, EpisodeOptions, chosen_scene
from examples.grasp_stages import (
    HELD_FOR,
    LIFT,
    LIFTED,
    CloseLook,
    choose_grasp,
    draw_back,
    holds_nothing,
    raise_torso,
    take,
)
from examples.parking import parking_places
from examples.pictures import Film, save_map_picture
from examples.pointing import click_on
from examples.report import write_report
from examples.summary import grasp_summary
from planning.drive import DriveReport
from planning.protocols import DistanceField
from planning.replanning import ReplanningConfig, ReplanningLoop
from robots.simulation import DepthFrame, GraspTask, Scene, SceneField

TRIES = 3
"""So often the robot grasps at most."""
PLACES = 3
"""The robot tries at most so many places to park."""


@dataclass(frozen=True)
class GraspOptions(EpisodeOptions):
    """Approach a table, map it, and lift an object off it."""

    distance: float = 1.6
    """How far from its parking place the robot starts, about [m]."""
    margin: float = 0.02
    """Clearance the arm keeps in the map where start and goal allow it [m]."""
    looks: int = 12
    """Depth images of the object from close by."""
    film: bool = True
    """Make the GIF; it takes about half a minute."""


class GraspEpisode:
    """The stages of one episode; `run` goes through them and says where it ended.

    Args:
        options: see `GraspOptions`.
        scene: with a grasp task; the one that the options name if None.
    """

    def __init__(self, options: GraspOptions, scene: Scene | None = None) -> None:
        self.options = options
        scene = scene or chosen_scene(options)
        if scene.grasp is None:
            raise SystemExit(f"{options.scene} has no object to grasp; choose apartment, office or flat")
        self.task: GraspTask = scene.grasp
        start = start_before(scene, self.task, options.distance, options.seed)
        self.episode = Episode(options, start, scene=scene)
        self.episode.robot.wait(1.0)  # until things have come to rest
        self.point = click_on(
            self.episode.world, self.task.object_name, np.array([*self.task.park[:2], 1.2]), options.seed
        )
        self.point = self.episode.live.moved_goal(self.point)
        self.clock = self.episode.clock()
        self.drive: DriveReport | None = None
        self.looked: tuple[DistanceField, DepthFrame] | None = None
        self.chosen: Grasp | None = None
        self.reason = ""
        self.planning_seconds = 0.0
        self.lift_height = 0.0
        self.tries = 0
        self.film = Film(self.episode, self.point, 0.7 if options.film else np.inf)
        self.close = CloseLook(self.episode, self.point, self.clock, self.film.add)
        self.bar = tqdm(desc="looking around", unit=" s", disable=None, bar_format="{desc}: {elapsed}")

    def run(self) -> str:
        """Returns "success" or the stage that failed."""
        self.go(self.episode.robot.base_state(), scan=2 * math.pi)
        ended, self.reason = "approach", "no place to park in reach of the point"
        for place in itertools.islice(self.places(), PLACES):
            self.bar.set_description("approaching")
            if not self.go(np.array(place)):
                assert self.drive is not None
                self.reason = self.drive.message
                continue
            ended = self.grasp_from_here()
            if ended != "planning":
                break
        return ended

    def grasp_from_here(self) -> str:
        """Look, reach and lift, and again if the hand comes up empty: "success", or the stage that failed."""
        robot, name = self.episode.robot, self.task.object_name
        tucked, ended = robot.posture(), "planning"
        for _ in range(TRIES):
            self.bar.set_description("looking closely and planning the reach")
            chosen = self.plan()
            if isinstance(chosen, str):
                self.reason = chosen if ended == "planning" else f"{self.reason}, then {chosen}"
                return ended
            self.bar.set_description("grasping")
            self.show(*chosen)
            self.tries += 1
            self.lift_height = take(self.episode, *chosen, name, self.film.add)
            ended, self.reason = "lift", "slipped out of the hand"
            if self.lift_height >= LIFTED:
                self.reason = ""
                return "success"
            if not holds_nothing(self.episode):
                self.reason = "held, but not high enough"
                return ended
            if not draw_back(self.episode, tucked, self.options.margin, self.options.seed):
                return ended
            self.close = CloseLook(self.episode, self.point, self.clock, self.film.add)  # it may have moved
        return ended

    def show(self, grasp: Grasp, reach: torch.Tensor) -> None:
        """Have film and viewer show what the arm is about to do."""
        self.chosen = grasp
        self.film.tool_way = self.tool_way()
        self.film.close_map = None if self.looked is None else self.looked[0]
        if self.film not in self.episode.robot.disturbances:
            self.episode.robot.disturbances.append(self.film)
        self.film.close_up = self.point
        self.episode.live.reach([reach, grasp.approach, grasp.lift])
        self.episode.live.say("grasping")

    def places(self) -> Iterator[tuple[float, float, float]]:
        """Places to park, each by the newest map and away from the earlier ones."""
        earlier: list[tuple[float, float, float]] = []
        while True:
            found = parking_places(
                self.episode.body,
                self.episode.field_for_driving(),
                self.point,
                self.episode.robot.base_state(),
            )
            apart = [p for p in found if all(math.dist(p[:2], e[:2]) > 0.25 for e in earlier)]
            if not apart:
                return
            earlier.append(apart[0])
            yield apart[0]

    def go(self, place: np.ndarray, scan: float = 0.0) -> bool:
        """Drive to a place (x, y [m], yaw [rad]), after a turn of `scan` [rad]."""
        episode = self.episode
        loop = ReplanningLoop(
            episode.robot,
            episode.body,
            episode.mapper,
            episode.field_for_driving,
            ReplanningConfig(scan=scan, time_limit=60.0),
            self.clock,
            self.watch,
            self.options.seed,
            episode.monitor,
            episode.spheres,
        )
        report = loop.drive_to(place[:2], final_yaw=float(place[2]))
        self.drive = report if self.drive is None else self.drive.joined(report)
        return report.success

    def watch(self, loop: ReplanningLoop) -> None:
        """Film and show a drive."""
        self.film.add(None if loop.plan is None else loop.plan.trajectory.waypoints.numpy())
        self.episode.live.follow(loop)

    def plan(self) -> tuple[Grasp, torch.Tensor] | str:
        """Look closely, then choose a grasp and the way to it; or say why there is none."""
        options, robot, live = self.options, self.episode.robot, self.episode.live
        tucked = float(robot.posture()[self.episode.model.joint_names.index(LIFT)])
        live.say("looking closely")
        self.close.look(options.looks)
        field = self.close.mapper.field()
        if live.last_frame is not None:
            self.looked = field, live.last_frame
        self.point = self.close.point = live.moved_goal(self.point)  # somebody may have dragged it
        live.look_closely(field, self.point)
        live.say("choosing a grasp")
        found, spent = self.clock.charge(
            lambda: choose_grasp(self.episode, self.close, options.margin, options.seed)
        )
        self.planning_seconds += spent
        robot.wait(spent)
        if isinstance(found, str):
            raise_torso(self.episode, tucked)
        return found

    def save_summary(self, path: Path, line: str) -> None:
        """One picture of the episode, with what happened in a line."""
        name, way = self.task.object_name, self.tool_way()
        grasp_summary(path, self.episode, self.point, name, self.looked, way, line)

    def tool_way(self) -> np.ndarray | None:
        """Where the hand was to go on its last straight line (n, 3) [m]."""
        if self.chosen is None:
            return None
        model, _ = parked(self.episode.model, self.episode.robot.posture())
        assert model.tool_link is not None
        return model.link_poses(self.chosen.approach, [model.tool_link])[:, 0, :3, 3].numpy()


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
        "reason": grasping.reason,
        "lift_height": grasping.lift_height,
        "tries": grasping.tries,
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
    save_map_picture(options.out / "map.png", episode, grasping.point)
    grasping.save_summary(
        options.out / "summary.png", f"{options.scene}, seed {options.seed}: {headline(report)}"
    )
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
        verdict = f"Failed at: {report['ended']}{report['reason'] and ' (' + report['reason'] + ')'}"
    return f"{verdict}, {report['contacts']} contacts with anything else, {report['robot_seconds']:.0f} s in all."


if __name__ == "__main__":
    options = tyro.cli(GraspOptions)
    outcome = main(options)
    print(headline(outcome))
    print(f"report: {options.out / 'report.html'}")
