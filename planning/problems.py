"""Motion planning problems in files: MotionBenchMaker's scenes of boxes and cylinders (Chamzas et al., RA-L 2022)."""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from planning.errors import ProblemError
from planning.primitive_field import PrimitiveField, Solid


@dataclass(frozen=True, eq=False)
class Problem:
    """One start and goal among solids.

    Args:
        set: name of the set it belongs to.
        index: its number there.
        joints: names in the order of start and goal.
        start: (dof,) [rad | m].
        goal: (dof,) [rad | m].
        posture: values [rad | m] of all joints of the robot that the file gives, planned or not.
        solids: the obstacles, in the robot's base frame.
    """

    set: str
    index: int
    joints: tuple[str, ...]
    start: Float[Tensor, " dof"]
    goal: Float[Tensor, " dof"]
    posture: Mapping[str, float]
    solids: tuple[Solid, ...]

    @property
    def field(self) -> PrimitiveField:
        """The distance field of the obstacles."""
        return PrimitiveField(self.solids)


def load_problems(path: str | Path) -> list[Problem]:
    """Read a JSON file (gzipped or not) with a list `problems`.

    Each has set, index, joints, start, goal, optionally start_all {joint: value}, and obstacles with type (box,
    cylinder or sphere), dimensions (full side lengths; height and radius; radius), position and quat_xyzw [m].

    Raises:
        ProblemError: where the file cannot be read or an entry is incomplete or malformed.
    """
    try:
        raw = Path(path).read_bytes()
        content = json.loads(gzip.decompress(raw) if raw[:2] == b"\x1f\x8b" else raw)
        entries = content["problems"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ProblemError(
            f"{path}: no JSON file with a list `problems` ({type(error).__name__}: {error})."
        ) from error
    return [_problem(entry, f"{path}: problem {i}") for i, entry in enumerate(entries)]


def _problem(entry: dict[str, Any], where: str) -> Problem:
    try:
        start, goal = (torch.tensor(entry[key], dtype=torch.float64) for key in ("start", "goal"))
        solids = tuple(
            Solid(
                o["type"],
                tuple(o["dimensions"]),
                tuple(o["position"]),
                tuple(o.get("quat_xyzw", (0, 0, 0, 1))),
            )
            for o in entry["obstacles"]
        )
        joints = tuple(entry["joints"])
        problem = Problem(
            str(entry["set"]),
            int(entry["index"]),
            joints,
            start,
            goal,
            dict(entry.get("start_all", {})),
            solids,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ProblemError(f"{where}: {type(error).__name__}: {error}.") from error
    if start.shape != (len(joints),) or goal.shape != start.shape:
        raise ProblemError(
            f"{where}: {len(joints)} joints, but start has {len(start)} values and goal {len(goal)}."
        )
    if not (torch.isfinite(start).all() and torch.isfinite(goal).all()):
        raise ProblemError(
            f"{where}: start and goal must be finite, got {start.tolist()} and {goal.tolist()}."
        )
    return problem
