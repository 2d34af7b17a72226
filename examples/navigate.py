"""A mobile manipulator enters a furnished room it has never seen, maps it and drives to a goal across it.

    python -m examples.navigate --out runs/navigate --scene apartment --seed 0

Leaves report.html, report.json, summary.png, states.npz (every executed step), map.png, mesh.ply, map.safetensors and
episode.gif. Success and contacts are read from the physics.
"""

from __future__ import annotations

import dataclasses
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

from examples.episode import Episode, EpisodeOptions
from examples.pictures import Film, save_map_picture
from examples.report import write_report
from examples.summary import drive_summary
from isdf.meshing import zero_level_mesh
from planning.drive import DriveReport
from planning.replanning import ReplanningConfig, ReplanningLoop


@dataclass(frozen=True)
class Navigate(EpisodeOptions):
    """Map an unknown furnished room and drive to a goal in it."""

    start: tuple[float, float, float] | None = None
    """Base pose x, y [m] and yaw [rad]; by default the scene's own."""
    goal: tuple[float, float] | None = None
    """x, y [m]; by default the scene's own."""
    film: bool = True
    """Make the GIF; it takes about half a minute."""


def main(options: Navigate) -> dict:
    """Run one episode and write its results; returns the report."""
    torch.set_num_threads(1)
    episode = Episode(options, options.start)
    goal = np.array(options.goal or (episode.scene.goal or _no_goal(options))[:2])
    film = Film(episode, goal, least_gap=1.0 if options.film else np.inf)
    started = time.perf_counter()
    with tqdm(desc="driving", unit=" rounds", disable=None) as bar:

        def watch(loop: ReplanningLoop) -> None:
            episode.live.follow(loop, goal_moves=True)
            film.add(None if loop.plan is None else loop.plan.trajectory.waypoints.numpy())
            left = np.linalg.norm(episode.robot.base_state()[:2] - goal)
            bar.set_postfix_str(f"t = {episode.robot.time:.0f} s, {left:.1f} m to go")
            bar.update()

        loop = ReplanningLoop(
            episode.robot,
            episode.body,
            episode.mapper,
            episode.field_for_driving,
            ReplanningConfig(),
            episode.clock(),
            watch,
            options.seed,
            episode.monitor,
            episode.spheres,
        )
        drive = loop.drive_to(goal)
    goal = loop.goal  # in the viewer it can be dragged
    report = _report(options, episode, goal, drive, time.perf_counter() - started)
    _write(options, episode, film, loop, report)
    episode.live.drive_on(loop)
    episode.close()
    return report


def _report(
    options: Navigate, episode: Episode, goal: np.ndarray, drive: DriveReport, wall_seconds: float
) -> dict:
    contacts = episode.contacts()
    start = episode.robot.recording.base_poses()[0]
    return {
        "example": "navigate",
        "scene": options.scene,
        "seed": options.seed,
        "success": drive.success and drive.goal_distance < 0.1,
        "contacts": len(contacts),
        "contact_pairs": contacts,
        "straight_line": float(np.linalg.norm(start[:2] - goal)),
        "goal": goal.tolist(),
        "drive": dataclasses.asdict(drive) | {"status": drive.status.value},
        "map": episode.map_report(),
        "wall_seconds": wall_seconds,
    }


def _write(options: Navigate, episode: Episode, film: Film, loop: ReplanningLoop, report: dict) -> None:
    out, goal = options.out, loop.goal
    out.mkdir(parents=True, exist_ok=True)
    episode.robot.recording.save(out / "states.npz")
    episode.save_map(out / "map.safetensors")
    zero_level_mesh(episode.mapper.field(), 0.05).export(out / "mesh.ply")
    save_map_picture(out / "map.png", episode, goal)
    plan = None if loop.plan is None else loop.plan.trajectory.waypoints.numpy()
    drive_summary(
        out / "summary.png", episode, goal, plan, f"{options.scene}, seed {options.seed}: {headline(report)}"
    )
    if options.film:
        film.save(out / "episode.gif")
    write_report(out, report, headline(report))


def headline(report: dict) -> str:
    """What happened, in a line."""
    drive = report["drive"]
    verdict = "Reached the goal" if report["success"] else f"Did not reach the goal ({drive['message']})"
    return (
        f"{verdict}: {drive['path_length']:.1f} m driven in {drive['duration']:.0f} s, {report['contacts']} contacts, "
        f"{drive['plans']} plans, slowed or stopped by the collision monitor for "
        f"{0.1 * (drive['slowed'] + drive['stopped'] + drive['blind']):.1f} s."
    )


def _no_goal(options: Navigate) -> tuple[float, float]:
    raise SystemExit(f"{options.scene} has no goal of its own: give --goal X Y")


if __name__ == "__main__":
    options = tyro.cli(Navigate)
    outcome = main(options)
    print(headline(outcome))
    print(f"report: {options.out / 'report.html'}")
