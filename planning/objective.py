"""The CHOMP objective of a whole trajectory: smoothness, obstacles and self-collision, with its gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from planning.costs import arc_length_cost, hinge_cost, self_collision_cost
from planning.errors import ConfigError
from planning.metric import Metric
from planning.numbers import refuse_nan
from planning.protocols import LinkedRobot, SelfCollidingRobot, SphereRobot
from planning.sphere_kinematics import kinematics_of
from planning.workspace import Workspace


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights of smoothness_weight F + obstacle_weight U_obs + self_collision_weight U_self.

    Args:
        smoothness_weight: small, since free paths matter more than short ones.
        obstacle_weight: of the arc-length functional, summed over spheres.
        self_collision_weight: of the cost of gaps between links, averaged over the waypoints.
        self_collision_eps: gap [m] between links at which their cost starts.
        margin: clearance [m] from which a waypoint counts as free while optimising, or that of start and goal
            where it is less. A little more than the check demands, since it also looks between the waypoints.
    """

    smoothness_weight: float = 0.05
    obstacle_weight: float = 1.0
    self_collision_weight: float = 2.0
    self_collision_eps: float = 0.03
    margin: float = 0.005

    def __post_init__(self) -> None:
        refuse_nan(self)
        weights = (self.smoothness_weight, self.obstacle_weight, self.self_collision_weight)
        if min(weights) < 0 or self.self_collision_eps <= 0:
            raise ConfigError(
                "ObjectiveConfig: weights must not be negative and self_collision_eps must be positive, "
                f"got {self}."
            )


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The objective at a trajectory or at each of a batch.

    Args:
        total: the weighted sum.
        gradient: of the total over the interior waypoints.
        free: whether every state looked at keeps clear of obstacles and of itself.
    """

    total: Float[Tensor, "*batch"]
    gradient: Float[Tensor, "*batch n_interior dof"]
    free: Bool[Tensor, "*batch"]

    def where(self, choice: Bool[Tensor, "*batch"], other: Evaluation) -> Evaluation:
        """This evaluation where chosen, the other one elsewhere."""
        return Evaluation(
            torch.where(choice, self.total, other.total),
            torch.where(choice[..., None, None], self.gradient, other.gradient),
            torch.where(choice, self.free, other.free),
        )


class Objective:
    """Evaluates trajectories of n waypoints; looks at `substeps` states a segment.

    The gradient is exact for the discrete objective: spheres are pulled back to the joints by J^T, and states
    within a segment to its two waypoints.
    """

    def __init__(
        self,
        robot: SphereRobot,
        workspace: Workspace,
        metric: Metric,
        config: ObjectiveConfig,
        substeps: int = 1,
    ) -> None:
        self.robot, self.workspace, self.metric, self.config = robot, workspace, metric, config
        self.substeps = substeps
        self._kinematics = kinematics_of(robot)
        pairs = robot.self_collision_pairs if isinstance(robot, SelfCollidingRobot) else None
        self._pairs = pairs if pairs is not None and len(pairs) else None
        self._groups: Any = None
        self._known_radii: Tensor | None = None
        margin = torch.tensor(config.margin, dtype=torch.float64)
        self._free_cost = float(hinge_cost(margin, workspace.eps)[0]) + 1e-7

    def __call__(self, q: Float[Tensor, "*batch n dof"]) -> Evaluation:
        """Evaluate waypoints q [rad | m], the first and (unless the metric frees it) the last of which are fixed."""
        spread = _interpolation_matrix(q.shape[-2], self.substeps).to(q)
        states = spread @ q
        x, radii = self._kinematics.centres(states), self._radii(q)
        cost, cost_gradient = self.workspace.cost_and_gradient(x, radii)
        obstacles, pull = arc_length_cost(x, cost, cost_gradient)
        obstacles, pull = self.config.obstacle_weight * obstacles, self.config.obstacle_weight * pull
        # Start and goal are valid, or there is nothing to optimise; what costs no more than they is free.
        ends = cost[..., [0, -1], :].amax((-2, -1)).clamp_min(self._free_cost)
        free = (cost <= ends[..., None, None]).all(-1).all(-1)
        if self._pairs is not None:
            touch, push, gap = self_collision_cost(
                x, radii, self._pair_groups(x, radii), self.config.self_collision_eps
            )
            obstacles = obstacles + self.config.self_collision_weight * touch
            pull = pull + self.config.self_collision_weight * push
            ends_gap = gap[..., [0, -1]].amin(-1, keepdim=True).clamp_max(0.0)
            free &= (gap >= ends_gap).all(-1)
        state_gradient = self._kinematics.pull_back(states, x, pull)
        smoothness, smoothness_gradient = self.metric.smoothness(q)
        weight = self.config.smoothness_weight
        gradient = weight * smoothness_gradient + (spread.T @ state_gradient)[..., self.metric.interior, :]
        return Evaluation(weight * smoothness + obstacles, gradient, free)

    def _radii(self, q: Float[Tensor, "*batch n dof"]) -> Float[Tensor, " s"]:
        if self._known_radii is None or self._known_radii.dtype != q.dtype:
            with torch.no_grad():
                self._known_radii = self.robot.spheres(q.reshape(-1, q.shape[-1])[0])[1].to(q)
        return self._known_radii

    def _pair_groups(self, x: Float[Tensor, "*batch n s 3"], radii: Float[Tensor, " s"]) -> Any:
        """The pairs that must not touch, grouped by link at the first question."""
        if self._groups is None:
            from planning.compiled.self_collision import grouped

            links = self.robot.sphere_links if isinstance(self.robot, LinkedRobot) else None
            state = x.detach().reshape(-1, *x.shape[-2:])[0]
            assert self._pairs is not None
            self._groups = grouped(self._pairs.numpy(), links, state.double().numpy(), radii.double().numpy())
        return self._groups

    def tightened(self, waypoints_free: bool) -> Objective:
        """The objective for a trajectory that converged in collision.

        If its waypoints collide, smoothness counts four times less; if only the motion between them does,
        twice as many states a segment are looked at.
        """
        config, substeps = self.config, self.substeps
        if waypoints_free:
            substeps = 2 * substeps
        else:
            config = replace(config, smoothness_weight=config.smoothness_weight / 4)
        return Objective(self.robot, self.workspace, self.metric, config, substeps)


def _interpolation_matrix(num_waypoints: int, substeps: int) -> Float[Tensor, "m n"]:
    """Linear interpolation from waypoints to `substeps` states a segment and the last waypoint."""
    position = torch.arange((num_waypoints - 1) * substeps + 1, dtype=torch.float64) / substeps
    waypoints = torch.arange(num_waypoints, dtype=torch.float64)
    return (1 - (position[:, None] - waypoints).abs()).clamp_min(0)
