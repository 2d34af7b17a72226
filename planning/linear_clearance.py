"""Clearances of a motion's states from obstacles and from the robot itself, with their slopes by the joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from planning.protocols import CostField, DistanceField, SelfCollidingRobot, SphereRobot
from planning.sphere_kinematics import kinematics_of
from planning.workspace import Workspace, WorkspaceConfig

OBSTACLE_ROWS, SELF_ROWS = 6, 3  # the tightest constraints of each state
SHARES = np.array([0.25, 0.5, 0.75])  # where within a segment states are looked at; the worst is constrained
REACH = 0.3  # [m] of clearance beyond which an obstacle does not matter to the next step


@dataclass(frozen=True)
class Clearances:
    """Constraints gap + rows (q' - q) >= 0 on what a motion passes near q: waypoints and a state between each two.

    Args:
        gap: (2, segments, rows) [m] at the first waypoint and within every segment.
        rows: (2, segments, rows, dof), slopes by the configuration there.
        share: (segments,) where within its segment the second state lies, in (0, 1).
    """

    gap: Float[ndarray, "2 k rows"]
    rows: Float[ndarray, "2 k rows dof"]
    share: Float[ndarray, " k"]

    @property
    def violation(self) -> float:
        """Sum over segments of the worst violation [m]."""
        return float(np.maximum(0.0, -self.gap.min(axis=(0, 2))).sum())


class ClearanceModel:
    """Measures and linearises the clearances of a robot in a field.

    Args:
        robot: its spheres must stay clear, its self-collision pairs apart.
        sdf: the field.
        ends: start and goal; a sphere or pair that is closer there than its margin need not keep more elsewhere.
        margin: from obstacles [m].
        self_margin: between links [m].
        config: rules for the floor.
    """

    def __init__(
        self,
        robot: SphereRobot,
        sdf: DistanceField | CostField,
        ends: Float[ndarray, "2 dof"],
        margin: float,
        self_margin: float,
        config: WorkspaceConfig,
    ) -> None:
        self._workspace = Workspace(robot, sdf, REACH, config)
        self._kinematics = kinematics_of(robot)
        states = torch.from_numpy(ends)
        with torch.no_grad():
            self._radii = robot.spheres(states)[1].double()
        pairs = robot.self_collision_pairs if isinstance(robot, SelfCollidingRobot) else None
        self._pairs = pairs if pairs is not None else torch.zeros(0, 2, dtype=torch.long)
        centres = self._kinematics.centres(states)
        clearance = self._workspace.clearance(centres, self._radii)
        self._margins = clearance.amin(dim=0).clamp_max(margin)
        self._self_margins = self._gaps(centres)[0].amin(dim=0).clamp_max(self_margin)

    def at(self, q: Float[ndarray, "n dof"]) -> Clearances:
        """The tightest constraints of every waypoint but the last, and of the worst state after each."""
        within = torch.from_numpy(q[:-1] + SHARES[:, None, None] * np.diff(q, axis=0))
        room = self._workspace.clearance(self._kinematics.centres(within), self._radii) - self._margins
        worst = room.amin(dim=-1).argmin(dim=0)
        segments = torch.arange(len(worst))
        states = torch.stack([torch.from_numpy(q[:-1]), within[worst, segments]])
        gap, rows = self._tightest(states.flatten(0, 1))
        count = OBSTACLE_ROWS + SELF_ROWS
        return Clearances(
            gap.view(2, -1, count).numpy(), rows.view(2, len(worst), count, -1).numpy(), SHARES[worst.numpy()]
        )

    def _tightest(
        self, states: Float[Tensor, "n dof"]
    ) -> tuple[Float[Tensor, "n rows"], Float[Tensor, "n rows dof"]]:
        """Gaps [m] of the spheres and pairs with the least room in each state, and their slopes."""
        centres = self._kinematics.centres(states)
        clearance, gradient = self._workspace.clearance_and_gradient(centres, self._radii)
        n, spheres = clearance.shape
        room, sphere = _least(clearance - self._margins, OBSTACLE_ROWS)
        gaps, normals = self._gaps(centres)
        apart, pair = _least(gaps - self._self_margins, SELF_ROWS)
        count, state = OBSTACLE_ROWS + SELF_ROWS, torch.arange(n)[:, None]
        forces = torch.zeros(n, count, spheres, 3, dtype=torch.float64)
        gap = torch.full((n, count), REACH, dtype=torch.float64)
        near, touching = torch.arange(room.shape[1]), OBSTACLE_ROWS + torch.arange(apart.shape[1])
        gap[:, near], gap[:, touching] = room, apart
        forces[state, near, sphere] = gradient[state, sphere]
        forces[state, touching, self._pairs[pair, 0]] = normals[state, pair]
        forces[state, touching, self._pairs[pair, 1]] = -normals[state, pair]
        forces[gap >= REACH] = 0.0
        return gap.clamp_max(REACH), self._pulled(states, centres, forces)

    def _pulled(
        self,
        states: Float[Tensor, "n dof"],
        centres: Float[Tensor, "n s 3"],
        forces: Float[Tensor, "n rows s 3"],
    ) -> Float[Tensor, "n rows dof"]:
        """J^T of every row's forces."""
        count = forces.shape[1]
        repeated = states[:, None].expand(-1, count, -1).reshape(-1, states.shape[1])
        points = centres[:, None].expand(-1, count, -1, -1).flatten(0, 1)
        return self._kinematics.pull_back(repeated, points, forces.flatten(0, 1)).view(len(states), count, -1)

    def _gaps(self, centres: Float[Tensor, "n s 3"]) -> tuple[Float[Tensor, "n p"], Float[Tensor, "n p 3"]]:
        """Gaps [m] of the pairs, and directions from their second sphere to their first."""
        first, second = self._pairs.unbind(dim=1)
        apart = centres[:, first] - centres[:, second]
        distance = apart.norm(dim=-1, keepdim=True)
        touching = self._radii[first] + self._radii[second]
        return distance.squeeze(-1) - touching, apart / distance.clamp_min(1e-9)


def _least(room: Float[Tensor, "n m"], count: int) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """The least values of each state, and which they are."""
    values, index = room.topk(min(count, room.shape[1]), dim=1, largest=False)
    return values, index
