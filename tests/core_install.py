"""Map a room and plan through it with what a core install has: `python -m tests.core_install`."""

from __future__ import annotations

import importlib.util
import math
import sys

import torch
from torch import Tensor

import isdf
import planning
from tests.isdf.rooms import furnished_orbit, furnished_room

OPTIONAL = ("pybullet", "casadi", "pytorch_kinematics", "rosbags", "embreex", "pyrealsense2", "viser")


class Ball:
    """A robot that is one sphere: q = (x, y, z)."""

    num_dofs = 3
    joint_names = ("x", "y", "z")
    joint_limits = torch.tensor([[-math.inf, math.inf]] * 3)
    velocity_limits = torch.ones(3)

    def spheres(self, q: Tensor) -> tuple[Tensor, Tensor]:
        return q.unsqueeze(-2), torch.tensor([0.15]).to(q)


def main() -> None:
    """Raises where something that a core install lacks is needed."""
    mapper = isdf.Mapper()
    for frame in furnished_orbit(12):
        mapper.integrate(frame)
    mapper.refresh()
    field = mapper.field()
    assert field.distance(furnished_orbit(12)[0].thinned(4, 4.0)).abs().median() < 0.03
    # From one side of the table to the other, at the height of its board.
    start, goal = torch.tensor([1.1, -0.4, 0.72]), torch.tensor([1.1, 1.4, 0.9])
    result = planning.Planner(Ball()).plan(start, goal, field)
    assert result.success, result
    assert furnished_room()(result.trajectory.waypoints).min() > 0.12
    loaded = [name for name in OPTIONAL if sys.modules.get(name) is not None]
    assert not loaded, f"mapping and planning loaded {loaded}"


if __name__ == "__main__":
    if "--blocked" in sys.argv:
        sys.modules.update(dict.fromkeys(OPTIONAL))  # importing them fails as if they were not installed
    else:
        present = [name for name in OPTIONAL if importlib.util.find_spec(name)]
        assert not present, f"this is no core install: it has {present}"
    main()
