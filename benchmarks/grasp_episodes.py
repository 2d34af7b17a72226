"""Grasps of things on tables, counters and shelves, of which only a point somebody clicked is known."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.episodes import EpisodesOptions
from benchmarks.grasp_scenes import ROOMS, SUPPORTS, Support, grasp_scene, thing_named, things
from benchmarks.recheck import recheck
from examples.arm import HAND
from examples.grasp import GraspEpisode, GraspOptions
from examples.maps import Method
from robots.simulation import Scene


@dataclass(frozen=True, kw_only=True)
class GraspThings(EpisodesOptions):
    """Lift things off tables, counters and shelves, and count which stage lost the others."""

    objects: Path | None = None
    """Folder of folders with a URDF object each, such as the YCB set's; simple shapes of our own by default."""
    method: Method = "default"
    """The map to drive by and to move the arm in."""

    def tasks(self) -> list[GraspTaskOf]:
        """One for each episode: things, rooms and supports take turns."""
        names = things(self.objects)
        rng = np.random.default_rng(self.seed)
        order = [
            name for _ in range(-(-self.episodes // len(names))) for name in rng.permutation(names).tolist()
        ]
        folder = self.out / ("shapes" if self.objects is None else self.objects.resolve().name) / self.method
        return [
            GraspTaskOf(
                str((folder / f"{number:03d}").resolve()),
                number,
                order[number],
                ROOMS[number % len(ROOMS)],
                SUPPORTS[number // len(ROOMS) % len(SUPPORTS)],
                self.seed * 1000 + number,
                self.method,
            )
            for number in range(self.episodes)
        ]

    def summary(self, reports: list[dict]) -> str:
        """Success by thing, what the others ended with, and contacts."""
        return summary(reports)


@dataclass(frozen=True)
class GraspTaskOf:
    """One episode: everything it needs to run anywhere."""

    folder: str
    number: int
    thing: str
    room: str
    support: Support
    seed: int
    method: Method

    def told(self) -> dict:
        """What its report says of it."""
        return dataclasses.asdict(self) | {"thing": Path(self.thing).name}

    def the_scene(self) -> Scene:
        """The scene, made anew."""
        return grasp_scene(self.room, self.seed, self.support, thing_named(self.thing))

    def run(self) -> dict:
        """Drive up, look, grasp and lift; returns the report."""
        torch.set_num_threads(1)
        began, folder = time.process_time(), Path(self.folder)
        options = GraspOptions(folder, self.room, self.seed, method=self.method, film=False)
        grasping = GraspEpisode(options, self.the_scene())
        ended = grasping.run()
        grasping.bar.close()
        recording, drive = grasping.episode.robot.recording, grasping.drive
        assert drive is not None
        folder.mkdir(parents=True, exist_ok=True)
        recording.save(folder / "states.npz")
        contacts = unwanted(recording.touched())
        report = {
            "ended": ended,
            "reason": grasping.reason,
            "lifted": ended == "success",
            "lift_height": grasping.lift_height,
            "tries": grasping.tries,
            "contacts": contacts,
            "drive": dataclasses.asdict(drive) | {"status": drive.status.value},
            "planning_seconds": grasping.planning_seconds,
            "robot_seconds": grasping.episode.robot.time,
        }
        spent = time.process_time() - began
        line = f"{Path(self.thing).name}, {self.support}, episode {self.number}: {ended} {grasping.reason}"
        grasping.save_summary(folder / "summary.png", line)
        grasping.episode.close()
        again = unwanted(recheck(self.the_scene(), folder / "states.npz", watched="target"))
        return report | {
            "success": ended == "success" and not contacts and not again,
            "contacts_rechecked": again,
            "cpu_seconds": spent,
        }


def unwanted(touched: dict[str, float]) -> dict[str, float]:
    """The contacts but for those of what is taken with the hand and with the parts of what it stands on."""
    wanted = {f"{link} - target" for link in HAND}
    return {
        pair: depth
        for pair, depth in touched.items()
        if pair not in wanted and not pair.startswith("target - support.")
    }


def lost_at(report: dict) -> str:
    """The stage that an episode without success ended at."""
    if "error" in report:
        return "error"
    return "contact" if report["lifted"] else report["ended"]


def summary(reports: list[dict]) -> str:
    """Tables of results by thing and by support, and what became of the episodes that failed."""
    ran = [r for r in reports if "error" not in r]
    lifted, clean = sum(r["lifted"] for r in ran), sum(r["success"] for r in ran)
    lost = Counter(lost_at(r) for r in reports if not r["success"])
    stages = ", ".join(f"{stage} {count}" for stage, count in lost.most_common())
    lines = [
        f"{len(reports)} episodes, {lifted} lifted and held, {clean} of these without any other contact. "
        f"Lost: {stages or 'none'}."
    ]
    for key in ("thing", "support"):
        lines += ["", f"| {key} | episodes | lifted | with other contacts |", "| --- | --- | --- | --- |"]
        for name in sorted({r["task"][key] for r in reports}):
            mine = [r for r in reports if r["task"][key] == name]
            touched = sum(bool(r.get("contacts") or r.get("contacts_rechecked")) for r in mine)
            lines.append(
                f"| {name} | {len(mine)} | {sum(r.get('lifted', False) for r in mine)} | {touched} |"
            )
    for r in reports:
        touch = ", ".join({**r.get("contacts", {}), **r.get("contacts_rechecked", {})})
        why = r.get("error") or ("" if r["lifted"] else f"{r['ended']}: {r['reason']}")
        if why or touch:
            told = r["task"]
            lines.append(
                f"\nepisode {told['number']} ({told['thing']}, {told['support']}): "
                f"{why}{'; ' if why and touch else ''}{touch and 'touched ' + touch}"
            )
    return "\n".join(lines) + "\n"
