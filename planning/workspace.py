"""Distances and costs of a robot's spheres in a field, with the rules for the floor and for unknown space."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from planning.costs import hinge_cost
from planning.errors import ConfigError, FieldError
from planning.numbers import refuse_nan
from planning.protocols import (
    CompilableField,
    ConfidentField,
    CostField,
    DistanceField,
    FloorRobot,
    SphereRobot,
)

MIN_FLOOR_SLOPE = 0.5  # upward component of a field's gradient where the floor, and not a wall, is nearest


@dataclass(frozen=True)
class WorkspaceConfig:
    """How fields are read.

    Args:
        floor_tolerance: a floor sphere is exempt while |f(c) - c_z| is at most this [m], that is while the
            floor z = 0 is what is nearest to it, and f increases upwards. Covers the error of a mapped floor.
        unknown_confidence: space of lower confidence counts as blocked in searches and has at least the cost
            c(0) of a surface, where the field offers confidence; None takes the field at its word.
        unknown_forbidden: such space is not to be entered at any price: a trajectory through it fails the dense check.
        chunk: most points in one query of the field, to bound memory.
    """

    floor_tolerance: float = 0.10
    unknown_confidence: float | None = None
    unknown_forbidden: bool = False
    chunk: int = 100_000

    def __post_init__(self) -> None:
        refuse_nan(self)
        if self.floor_tolerance < 0 or self.chunk < 1:
            raise ConfigError(
                f"WorkspaceConfig: floor_tolerance must be >= 0 m and chunk >= 1, "
                f"got {self.floor_tolerance:g} and {self.chunk}."
            )
        if self.unknown_forbidden and self.unknown_confidence is None:
            raise ConfigError(
                "WorkspaceConfig: unknown_forbidden needs unknown_confidence, below which space counts as unknown."
            )


class Workspace:
    """A robot's spheres in a distance field or in a cost field over one.

    Args:
        robot: gives radii and, where it offers them, floor spheres.
        sdf: what to keep clear of.
        eps: range [m] of the cost c of a distance field; a cost field brings its own.
        config: rules for the floor and for unknown space.

    Raises:
        FieldError: if `sdf` is neither a DistanceField nor a CostField.
    """

    def __init__(
        self,
        robot: SphereRobot,
        sdf: DistanceField | CostField,
        eps: float,
        config: WorkspaceConfig | None = None,
    ) -> None:
        self.config = config or WorkspaceConfig()
        self.cost_field = sdf if isinstance(sdf, CostField) else None
        field = sdf.field if isinstance(sdf, CostField) else sdf
        if not isinstance(field, DistanceField):
            raise FieldError(
                f"Workspace: {type(field).__name__} is no field; it needs distance(points) and "
                "distance_and_gradient(points), or eps, field and cost_and_gradient(points, radii)."
            )
        self.field = field
        self.eps = self.cost_field.eps if self.cost_field else eps
        self._solids = None
        if isinstance(field, CompilableField):
            from planning.compiled.arrays import solids_of

            self._solids = solids_of(field)
        self.floor = (
            robot.floor_spheres if isinstance(robot, FloorRobot) and robot.floor_spheres.any() else None
        )

    def clearance(
        self, centres: Float[Tensor, "*batch s 3"], radii: Float[Tensor, " s"]
    ) -> Float[Tensor, "*batch s"]:
        """Clearance f(c) - r [m] of every sphere; +inf where it may touch the floor, NaN where f is."""
        with torch.no_grad():
            flat = centres.reshape(-1, 3)
            distance = torch.cat([self.field.distance(p) for p in flat.split(self.config.chunk)])
            distance = distance.view(centres.shape[:-1])
        clearance = distance - radii
        if self.floor is None:
            return clearance
        return clearance.masked_fill(self._on_floor(distance[..., self.floor], centres), torch.inf)

    def unknown(self, centres: Float[Tensor, "*batch s 3"]) -> Bool[Tensor, "*batch s"] | None:
        """Which spheres are centred in unknown space; None where nothing counts as unknown."""
        threshold = self.config.unknown_confidence
        if threshold is None or not isinstance(self.field, ConfidentField):
            return None
        with torch.no_grad():
            flat = centres.reshape(-1, 3)
            confidence = torch.cat([self.field.confidence(p) for p in flat.split(self.config.chunk)])
        return (confidence < threshold).view(centres.shape[:-1])

    def cost_and_gradient(
        self, centres: Float[Tensor, "*batch s 3"], radii: Float[Tensor, " s"]
    ) -> tuple[Float[Tensor, "*batch s"], Float[Tensor, "*batch s 3"]]:
        """Cost c of every sphere and its gradient with respect to the centres, without a graph."""
        if self.cost_field is not None:
            cost, gradient = self.cost_field.cost_and_gradient(centres, radii)
            cost, gradient = cost.detach(), gradient.detach()
            if self.floor is not None:
                with torch.no_grad():
                    exempt = self._on_floor(self.field.distance(centres[..., self.floor, :]), centres)
                cost = cost.masked_fill(exempt, 0.0)
                gradient = gradient.masked_fill(exempt.unsqueeze(-1), 0.0)
        else:
            clearance, gradient = self.clearance_and_gradient(centres, radii)
            cost, slope = hinge_cost(clearance, self.eps)
            gradient = slope.unsqueeze(-1) * gradient
        unknown = self.unknown(centres)
        if unknown is not None:
            cost = torch.where(unknown, cost.clamp_min(0.5 * self.eps), cost)
        return cost, gradient

    def clearance_and_gradient(
        self, centres: Float[Tensor, "*batch s 3"], radii: Float[Tensor, " s"]
    ) -> tuple[Float[Tensor, "*batch s"], Float[Tensor, "*batch s 3"]]:
        """Clearances, and gradients of the field where they are below eps."""
        if self._solids is not None:
            from planning.compiled.solids import distances_and_gradients

            points = centres.detach().reshape(-1, 3).double().numpy()
            far, up = distances_and_gradients(self._solids, points, (radii.double() + self.eps).numpy())
            distance = torch.from_numpy(far).to(centres).view(centres.shape[:-1])
            gradient, clearance = torch.from_numpy(up).to(centres).view(centres.shape), distance - radii
            if self.floor is not None:
                clearance = clearance.masked_fill(
                    self._on_floor(distance[..., self.floor], centres), torch.inf
                )
            return clearance, gradient
        clearance = self.clearance(centres, radii)
        near = clearance < self.eps
        gradient = torch.zeros_like(centres)
        if near.any():  # most spheres are far from anything, and gradients cost more than distances
            gradient[near] = self.field.distance_and_gradient(centres[near])[1].detach()
        return clearance, gradient

    def _on_floor(
        self, floor_distance: Float[Tensor, "*batch floor"], centres: Float[Tensor, "*batch s 3"]
    ) -> Bool[Tensor, "*batch s"]:
        """Which spheres are exempt since the floor is what is nearest to them, given floor spheres'
        distances.

        The distance alone would also excuse a wall that is nearly as near as the floor, up to the tolerance
        deep in the sphere; so the field must also increase upwards there.
        """
        centres_above = centres[..., self.floor, :]
        exempt = (floor_distance - centres_above[..., 2]).abs() <= self.config.floor_tolerance
        if exempt.any():
            _, gradient = self.field.distance_and_gradient(centres_above[exempt])
            exempt[exempt.clone()] = gradient[..., 2] > MIN_FLOOR_SLOPE
        on_floor = torch.zeros(centres.shape[:-1], dtype=torch.bool)
        on_floor[..., self.floor] = exempt
        return on_floor
