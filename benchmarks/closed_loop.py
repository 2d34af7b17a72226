"""Closed-loop episodes in numbers: drives through scenes nobody mapped, and grasps of things nobody described.

    python -m benchmarks.closed_loop navigate --scene home_1 --episodes 50 --jobs 2 --out runs/closed_loop
    python -m benchmarks.closed_loop navigate --scene house.urdf --disturb pose-noise --out runs/closed_loop
    python -m benchmarks.closed_loop navigate --method exact --backend dask --cluster tcp://host:8786
    python -m benchmarks.closed_loop grasp --objects FOLDER --episodes 50 --out runs/grasps

Every episode leaves report.json, summary.png and states.npz (time, base pose, joint positions, head, poses of all that
moves) in OUT/SCENE/METHOD/DISTURBANCE/NUMBER or OUT/OBJECTS/METHOD/NUMBER, the summary is OUT/summary.md. Contacts are
counted twice: by the physics while it runs, and from the recorded states in a fresh world.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.episodes import run_missing
from benchmarks.grasp_episodes import GraspThings
from benchmarks.navigation_episodes import Navigate

Command = (
    Annotated[Navigate, tyro.conf.subcommand("navigate")]
    | Annotated[GraspThings, tyro.conf.subcommand("grasp")]
)

if __name__ == "__main__":
    run_missing(tyro.cli(Command, description=__doc__))  # type: ignore[arg-type]
