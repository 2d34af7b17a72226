"""Drives from random starts to random goals in scenes nobody mapped."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from benchmarks.episodes import EpisodesOptions
from benchmarks.free_floor import FreeFloor
from benchmarks.recheck import recheck
from examples.disturbances import Disturbance, MovedFurniture, People, PoseNoise
from examples.episode import Episode, EpisodeOptions
from examples.maps import Method
from examples.summary import drive_summary
from planning.replanning import ReplanningConfig, ReplanningLoop
from robots.simulation import Scene, SimulatedMobileRobot, load_urdf_scene, make_scene

Kind = Literal["none", "pose-noise", "people", "moved"]
RADIUS = 0.36
"""Of the tucked robot, turned any way [m]."""
ROOM = 0.12
"""Clearance [m] of starts and goals."""
APART = 4.0
"""Least straight distance between start and goal [m]."""
BESIDE_PEOPLE = 0.1
"""Gap that people leave to walls and furniture [m]."""


@dataclass(frozen=True, kw_only=True)
class Navigate(EpisodesOptions):
    """Drive from random starts to random goals and count successes and contacts."""

    scene: str = "home_1"
    """A furnished room by name, or a .urdf file."""
    method: Method = "default"
    """The map to drive by."""
    disturb: Kind = "none"
    """What makes it harder: a shaking camera pose, three people, or furniture moved after it was mapped."""

    def tasks(self) -> list[NavigationTask]:
        """One for each episode."""
        return make_tasks(self)

    def summary(self, reports: list[dict]) -> str:
        """A table of one line, and what became of the episodes that failed."""
        return summary(self, reports)


@dataclass(frozen=True)
class NavigationTask:
    """One episode: everything it needs to run anywhere."""

    folder: str
    scene: str
    scene_seed: int
    number: int
    method: Method
    disturb: Kind
    start: tuple[float, float, float]
    goal: tuple[float, float]
    shortest: float
    furniture: tuple[str, float, float] | None = None
    places: tuple[tuple[float, float], ...] = ()

    def told(self) -> dict:
        """What its report says of it."""
        told = dataclasses.asdict(self)
        del told["places"]
        return told

    def run(self) -> dict:
        """Drive; returns the report."""
        return episode(self)

    def the_scene(self) -> Scene:
        """The scene, made anew."""
        return (
            load_urdf_scene(self.scene)
            if self.scene.endswith(".urdf")
            else make_scene(self.scene, self.scene_seed)
        )


def make_tasks(options: Navigate) -> list[NavigationTask]:
    """Draw starts and goals that the robot fits at and that are joined by a free way."""
    rng = np.random.default_rng([options.seed, *options.scene.encode()])
    scene = load_urdf_scene(options.scene) if options.scene.endswith(".urdf") else make_scene(options.scene)
    floor = FreeFloor.of(scene, RADIUS)
    places = floor.places(ROOM)
    walked = people_places(scene) if options.disturb == "people" else ()
    name = Path(options.scene).stem
    folder = options.out / name / options.method / options.disturb
    tasks: list[NavigationTask] = []
    for _ in range(200 * options.episodes):
        if len(tasks) == options.episodes:
            break
        start, goal = places[rng.choice(len(places), 2, replace=False)] if len(places) > 1 else (None, None)
        if start is None or np.linalg.norm(start - goal) < APART:
            continue
        number, yaw = len(tasks), float(rng.uniform(-np.pi, np.pi))
        tasks.append(
            NavigationTask(
                str((folder / f"{number:03d}").resolve()),
                str(Path(options.scene).resolve()) if options.scene.endswith(".urdf") else options.scene,
                0,
                number,
                options.method,
                options.disturb,
                (float(start[0]), float(start[1]), yaw),
                (float(goal[0]), float(goal[1])),
                floor.shortest(start, goal),
                _furniture(scene, floor, start, goal, rng) if options.disturb == "moved" else None,
                walked,
            )
        )
    if len(tasks) < options.episodes:
        raise SystemExit(f"{options.scene}: only {len(tasks)} starts and goals {APART:g} m apart were found")
    return tasks


def people_places(scene: Scene) -> tuple[tuple[float, float], ...]:
    """Where people walk: they are narrower than the robot, and get past it where it cannot pass."""
    floor = FreeFloor.of(scene, People.RADIUS, heights=(0.06, People.HEIGHT))
    return tuple(map(tuple, floor.places(BESIDE_PEOPLE).tolist()))


def _furniture(
    scene: Scene, floor: FreeFloor, start: np.ndarray, goal: np.ndarray, rng: np.random.Generator
) -> tuple[str, float, float]:
    """A piece of furniture, and a place beside the way for it to be moved to that leaves a way to the goal."""
    small = [s for s in scene.static if s.name not in ("floor", "ceiling") and 0.2 < s.bounding_radius < 0.8]
    if not small:
        raise SystemExit(f"{scene.name}: nothing in it can be moved; choose a furnished room")
    for _ in range(500):
        solid = small[rng.integers(len(small))]
        place = floor.places(ROOM)[rng.integers(len(floor.places(ROOM)))]
        away = min(np.linalg.norm(place - start), np.linalg.norm(place - goal))
        if away > solid.bounding_radius + RADIUS + 0.5:
            blocked = dataclasses.replace(floor, clearance=floor.clearance.copy())
            cells = np.stack(np.meshgrid(*map(np.arange, floor.clearance.shape), indexing="ij"), axis=-1)
            near = np.linalg.norm(floor.low + floor.spacing * cells - place, axis=-1)
            blocked.clearance[near < solid.bounding_radius + RADIUS + 0.1] = -1.0
            if np.isfinite(blocked.shortest(start, goal)):
                return solid.name, float(place[0]), float(place[1])
    raise SystemExit(f"{scene.name}: no place was found to move furniture to")


def episode(task: NavigationTask) -> dict:
    """Drive one episode; returns its report."""
    torch.set_num_threads(1)
    began = time.process_time()
    folder = Path(task.folder)
    options = EpisodeOptions(folder, task.scene, task.number, method=task.method)
    ride = Episode(options, task.start, disturbances(task), task.the_scene())
    planning_times: list[float] = []

    def watch(loop: ReplanningLoop) -> None:
        if loop.report.plans > len(planning_times):
            planning_times.append(loop.last_planning)

    config = ReplanningConfig(time_limit=120.0 + 10.0 * task.shortest)
    loop = ReplanningLoop(
        ride.robot, ride.body, ride.mapper, ride.field_for_driving, config, ride.clock(), watch, task.number,
        ride.monitor,
        ride.spheres,
    )  # fmt: skip
    drive = loop.drive_to(np.array(task.goal))
    contacts = ride.contacts()
    folder.mkdir(parents=True, exist_ok=True)
    ride.robot.recording.save(folder / "states.npz")
    spent = time.process_time() - began
    plan = None if loop.plan is None else loop.plan.trajectory.waypoints.numpy()
    line = f"{Path(task.scene).stem}, episode {task.number}: {drive.message}, {len(contacts)} contacts"
    drive_summary(folder / "summary.png", ride, np.array(task.goal), plan, line)
    ride.close()
    again = recheck(task.the_scene(), folder / "states.npz")
    return {
        "success": drive.success and drive.goal_distance < 0.1 and not contacts and not again,
        "reached": drive.success and drive.goal_distance < 0.1,
        "contacts": contacts,
        "contacts_rechecked": again,
        "drive": dataclasses.asdict(drive) | {"status": drive.status.value},
        "length_ratio": drive.path_length / task.shortest,
        "planning_times": planning_times,
        "cpu_seconds": spent,
    }


def disturbances(task: NavigationTask) -> list[Disturbance]:
    """What the task wants to be disturbed by."""
    if task.disturb == "pose-noise":
        return [PoseNoise(task.number)]
    if task.disturb == "people":
        return [People(np.array(task.places), 0.1, task.number)]
    if task.disturb == "moved":
        assert task.furniture is not None
        name, x, y = task.furniture
        place, middle = np.array([x, y]), (np.array(task.start[:2]) + np.array(task.goal)) / 2

        def when(robot: SimulatedMobileRobot) -> bool:
            here = robot.base_state()[:2]
            halfway = np.linalg.norm(here - task.goal) < np.linalg.norm(middle - task.goal)
            return bool(halfway and np.linalg.norm(here - place) > 1.5)

        return [MovedFurniture(name, place, when)]
    return []


def summary(options: Navigate, reports: list[dict]) -> str:
    """A table of one line, and what became of the episodes that failed."""
    ran = [r for r in reports if "drive" in r]
    reached = [r for r in ran if r["reached"]]
    ratios = [r["length_ratio"] for r in reached]
    plans = [seconds for r in ran for seconds in r["planning_times"]]
    touched = [r for r in ran if r["contacts"] or r["contacts_rechecked"]]
    quantile = lambda values, q: f"{np.quantile(values, q):.2f}" if values else "-"  # noqa: E731
    head = (
        "scene", "map", "disturbed by", "episodes", "reached", "with contact", "length ratio, median", "95 %",
        "planning 95 % [s]", "slowed or stopped [s an episode]",
    )  # fmt: skip
    held = [0.1 * (r["drive"]["slowed"] + r["drive"]["stopped"] + r["drive"]["blind"]) for r in ran]
    row = (
        Path(options.scene).stem, options.method, options.disturb, len(reports), len(reached), len(touched),
        quantile(ratios, 0.5), quantile(ratios, 0.95), quantile(plans, 0.95), f"{np.mean(held):.1f}" if held else "-",
    )  # fmt: skip
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (head, ["---"] * len(head), row)]
    for report in reports:
        reason = report.get("error") or (report["drive"]["message"] if not report["reached"] else "")
        touch = "" if "error" in report else ", ".join(report["contacts"] | report["contacts_rechecked"])
        if reason or touch:
            number = report["task"]["number"]
            lines.append(
                f"\nepisode {number}: {reason}{'; ' if reason and touch else ''}{touch and 'touched ' + touch}"
            )
    return "\n".join(lines) + "\n"
