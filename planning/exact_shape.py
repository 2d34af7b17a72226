"""A robot's exact shape among a field's solids, where both can be compiled: what the search and the check ask."""

from __future__ import annotations

from typing import TypeGuard
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from planning.protocols import CompilableField, CompilableRobot, CostField, DistanceField, SphereRobot
from planning.workspace import WorkspaceConfig

WIDEST_GAP = 0.05  # [m] between links beyond which nobody asks how far apart they are
LIMIT_TOLERANCE = 1e-5  # [rad | m] taken for rounding, as by the check
UNLIMITED = 1e3  # stands for the limit of a joint without one [rad | m]

_bodies: WeakKeyDictionary = (
    WeakKeyDictionary()
)  # robots are immutable, and building their trees takes a while


class ExactShape:
    """Compiled tests of a robot in a field; make one with `exact_shape`, which tells where it can be had."""

    def __init__(self, robot: CompilableRobot, field: CompilableField, tolerance: float) -> None:
        from planning.compiled.arrays import solids_of
        from planning.compiled.states import World

        chain, tree, weights = _body(robot)
        limits = robot.joint_limits.double().clamp(-UNLIMITED, UNLIMITED).numpy()
        self.robot = robot
        low, high = limits[:, 0] - LIMIT_TOLERANCE, limits[:, 1] + LIMIT_TOLERANCE
        self.world = World(chain, tree, solids_of(field), low, high, weights, 0.0, 0.0, tolerance)
        _compile(self.world)
        names = robot.sphere_links
        self._first_sphere = torch.tensor([names.index(name) for name in dict.fromkeys(names)])

    def measure(
        self, states: Float[Tensor, "m dof"], margin: float, self_margin: float
    ) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"], Float[Tensor, " m"], Int[Tensor, "m 2"]]:
        """Least clearance [m] and a sphere of its link, least gap [m] and spheres of its links, for every state.

        Values are exact for the least of all, for those below their margin, and at the last state; else they are
        lower bounds that keep the margin. No gap is told above `WIDEST_GAP`.
        """
        from planning.compiled.measure import measure

        order = np.arange(len(states)) - 1  # the last state first: both ends are to be told exactly
        depth, link, gap, pair = measure(
            self.world,
            states.double().numpy(),
            order % len(states),
            margin + 1e-3,
            self_margin + 1e-3,
            WIDEST_GAP,
        )
        return (
            torch.from_numpy(depth),
            self._first_sphere[torch.from_numpy(link)],
            torch.from_numpy(gap),
            self._first_sphere[torch.from_numpy(pair)],
        )


def exact_shape(
    robot: SphereRobot, sdf: DistanceField | CostField, config: WorkspaceConfig | None = None
) -> ExactShape | None:
    """The exact shape of a robot in a field, or None where one of them cannot be compiled, nor can unknown space."""
    field = sdf.field if isinstance(sdf, CostField) else sdf
    if not _compilable(robot) or not isinstance(field, CompilableField):
        return None
    config = config or WorkspaceConfig()
    if config.unknown_confidence is not None:
        return None
    return ExactShape(robot, field, config.floor_tolerance)


def _compilable(robot: SphereRobot) -> TypeGuard[CompilableRobot]:
    """Whether a robot can be compiled; asking for all it offers takes a while, so known ones are not asked again."""
    return robot in _bodies or isinstance(robot, CompilableRobot)


def _compile(world) -> None:  # type: ignore[no-untyped-def]
    """Compile the search, or load it from numba's cache, before anybody looks at a clock."""
    from planning.compiled.search import grow, length, planted, shorten
    from planning.compiled.states import edge_free, first_blocked

    if grow.signatures:
        return
    path = np.stack([0.5 * (world.low + world.high)] * 2)
    edge_free(world, path[0], path[1], 1.0)
    grow(world, planted(path[0], path[1], 2), np.random.default_rng(0), 1.0, 1.0, 1)
    shorten(world, path, np.random.default_rng(0), 1.0, 1)
    first_blocked(world, path, 1.0)
    length(path)


def _body(robot: CompilableRobot):  # type: ignore[no-untyped-def]
    if robot not in _bodies:
        from planning.compiled.arrays import chain_of, joint_weights, tree_of

        chain, tree = chain_of(robot), tree_of(robot)
        low, high = robot.joint_limits.double().clamp(-np.pi, np.pi).unbind(1)
        _bodies[robot] = (chain, tree, joint_weights(chain, tree, low.numpy(), high.numpy()))
    return _bodies[robot]
