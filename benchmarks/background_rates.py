"""How often planners can ask for distances while a map is made in the background: rates and delays in one process."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import isdf
from isdf.methods import new_mapper
from isdf.voxel import ExactConfig
from tests.isdf.rooms import furnished_orbit


@dataclass(frozen=True)
class Rates:
    """A mapper gets frames of a synthetic room at a camera's rate; planners ask at theirs."""

    method: Literal["default", "isdf", "exact"] = "default"
    planners: int = 4
    """Threads that ask."""
    rate: float = 1000.0
    """Questions a second that each thread aims at."""
    points: int = 64
    """Points of a question."""
    fps: float = 10.0
    """Frames a second."""
    seconds: float = 10.0
    """How long."""


def plan(background: isdf.BackgroundMapper, args: Rates, end: float, delays: list[float]) -> None:
    """Ask at the wanted rate until the end; note how late each answer came after its question was due [s]."""
    points = torch.rand(args.points, 3)
    due = time.monotonic()
    while due < end:
        time.sleep(max(0.0, due - time.monotonic()))
        asked = time.monotonic()
        background.field().distance(points)
        delays.append(time.monotonic() - asked)
        due = max(due + 1 / args.rate, asked)


def main(args: Rates) -> None:
    """Run and print."""
    torch.set_num_threads(1)
    frames = furnished_orbit(12)
    configs = {"default": isdf.MapperConfig(), "isdf": isdf.IsdfConfig(), "exact": ExactConfig()}
    with isdf.BackgroundMapper(new_mapper(configs[args.method])) as background:
        background.integrate(frames[0])
        background.flush()
        begun, end = background.rates(), time.monotonic() + args.seconds
        delays: list[list[float]] = [[] for _ in range(args.planners)]
        threads = [threading.Thread(target=plan, args=(background, args, end, own)) for own in delays]
        for thread in threads:
            thread.start()
        shown = 1
        while time.monotonic() < end:
            background.integrate(isdf.DepthFrame.of(frames[shown % len(frames)]))
            shown += 1
            time.sleep(1 / args.fps)
        for thread in threads:
            thread.join()
        rates = background.rates()
    every = 1000 * np.concatenate([np.array(own) for own in delays])
    print(f"{args.method}, {args.planners} planners at {args.rate:.0f} Hz, {args.points} points a question")
    print(f"  questions     {len(every) / args.seconds / args.planners:.0f} a second and planner")
    print(f"  answered in   {np.median(every):.2f} ms (median), {np.quantile(every, 0.99):.2f} ms (99 %)")
    print(f"  steps         {(rates.steps - begun.steps) / args.seconds:.1f} a second")
    print(f"  snapshots     {(rates.snapshots - begun.snapshots) / args.seconds:.1f} a second")
    print(
        f"  frames        {rates.used} used, {rates.dropped} dropped, {rates.refused} refused of {rates.received}"
    )


if __name__ == "__main__":
    main(tyro.cli(Rates, description=__doc__))
