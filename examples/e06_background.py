"""6. Plan while a map is made: frames go to a background mapper, planners ask its newest snapshot.

    python -m examples.e06_background runs/recorded

A ball of the size of a drone is planned from where the camera began to where it is now, again and again, each time in
the newest snapshot. Neither waits for the other: a full queue drops its oldest frame.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

import isdf
import planning
from isdf.datasets import open_sequence


class Ball:
    """A robot that is one sphere: q = (x, y, z). All that a planner needs to know of a robot."""

    num_dofs = 3
    joint_names = ("x", "y", "z")
    joint_limits = torch.tensor([[-math.inf, math.inf]] * 3)
    velocity_limits = torch.tensor([1.0, 1.0, 1.0])

    def __init__(self, radius: float) -> None:
        self.radius = radius

    def spheres(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Its only sphere: centres (..., 1, 3) and radii (1,) [m]."""
        return q.unsqueeze(-2), torch.tensor([self.radius]).to(q)


@dataclass(frozen=True)
class Background:
    """Map a recording in the background at its own pace, and plan in what is known so far."""

    sequence: tyro.conf.Positional[Path]
    """A recorded folder, or any other layout that `isdf map` reads."""
    radius: float = 0.15
    """Of the ball that is planned [m]."""
    speed: float = 1.0
    """How many times faster than recorded the frames come."""
    planners: int = 1
    """Threads that plan."""


def plan(
    background: isdf.BackgroundMapper,
    robot: Ball,
    way: list[Tensor],
    done: threading.Event,
    results: list[tuple[int, planning.PlanResult]],
) -> None:
    """Plan in the newest snapshot until `done`; note each snapshot's number and result."""
    planner = planning.Planner(robot, planning.PlannerConfig(num_waypoints=30))
    while not done.is_set():
        snapshot = background.snapshot()
        results.append((snapshot.number, planner.plan(way[0], way[-1] + 1e-3, snapshot.field)))


def main(options: Background) -> isdf.Rates:
    """Feed frames at their own pace while planners plan; returns the mapper's rates."""
    torch.set_num_threads(1)
    sequence = open_sequence(options.sequence)
    way: list[Tensor] = []  # camera positions: a ball fits where the camera was carried
    results: list[list[tuple[int, planning.PlanResult]]] = [[] for _ in range(options.planners)]
    done = threading.Event()
    with isdf.BackgroundMapper(isdf.Mapper(), queue_size=2) as background:
        threads = [
            threading.Thread(target=plan, args=(background, Ball(options.radius), way, done, own))
            for own in results
        ]
        for index in range(len(sequence)):
            frame = sequence[index]
            way.append(frame.T_world_camera[:3, 3].float())
            background.integrate(frame)  # returns at once
            if index == 0:
                background.flush()  # planners need a first snapshot
                for thread in threads:
                    thread.start()
            time.sleep(1 / sequence.fps / options.speed)
        background.flush()
        done.set()
        for thread in threads:
            thread.join()
        rates = background.rates()
    plans = [one for own in results for one in own]
    solved = sum(result.success for _, result in plans)
    print(f"{len(sequence)} frames in {rates.seconds:.1f} s: {rates.used} mapped, {rates.dropped} dropped")
    print(f"{rates.snapshots} snapshots, one every {1000 * rates.snapshot_interval:.0f} ms")
    print(f"{len(plans)} plans in {len({number for number, _ in plans})} of them, {solved} clear")
    print(f"the last: {plans[-1][1]}")
    return rates


if __name__ == "__main__":
    main(tyro.cli(Background, description=__doc__))
