"""The small contracts through which planning sees maps and robots; any object with these members will do.

Positions are in the world frame in metres. Members that only some fields or robots offer are Protocols of
their own, so that `isinstance` tells whether they are there.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor


@runtime_checkable
class DistanceField(Protocol):
    """A signed distance field [m]: positive outside obstacles, negative inside."""

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distances [m] at points [m], differentiable by autograd."""
        ...

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distances [m] and their gradients at points [m], without an autograd graph."""
        ...


@runtime_checkable
class ConfidentField(DistanceField, Protocol):
    """A distance field that also knows where it was observed."""

    def confidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Confidence in [0, 1] at points [m]: 0 where nothing was ever seen."""
        ...


@runtime_checkable
class ObservingField(DistanceField, Protocol):
    """A distance field that tells space that was looked at from space that was not, however sure its distances are."""

    def observed(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether somebody looked at points [m]: False where the field only guesses."""
        ...


@runtime_checkable
class ChangingField(DistanceField, Protocol):
    """A distance field that knows where something has come lately, such as somebody who walks about."""

    def came(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether surfaces at points [m] belong to something that came lately; its far side was not seen."""
        ...


@runtime_checkable
class SurveyedField(DistanceField, Protocol):
    """A distance field that tells surfaces that were seen from those that it guesses."""

    def surface_seen(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether the surface nearest to points [m] was seen."""
        ...


@runtime_checkable
class CostField(Protocol):
    """An obstacle cost c(f(x) - r) over a distance field f, as in CHOMP (Zucker et al. 2013, section 3.2)."""

    @property
    def eps(self) -> float:
        """Distance [m] from a surface at which the cost starts."""
        ...

    @property
    def field(self) -> DistanceField:
        """The distance field below the cost; it decides what is in collision."""
        ...

    def cost_and_gradient(
        self, points: Float[Tensor, "*batch 3"], radii: Float[Tensor, "*#batch"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Costs [m] of spheres of given radii [m] at points [m], and their gradients, without a graph."""
        ...


@runtime_checkable
class SphereRobot(Protocol):
    """A robot whose body is covered by spheres that move with its joints."""

    @property
    def num_dofs(self) -> int:
        """Number of joints, the length of a configuration q."""
        ...

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names in the order of q."""
        ...

    @property
    def joint_limits(self) -> Float[Tensor, "dof 2"]:
        """Lower and upper limits [rad | m]; -inf and inf where a joint has none."""
        ...

    @property
    def velocity_limits(self) -> Float[Tensor, " dof"]:
        """Largest joint speeds [rad/s | m/s]."""
        ...

    def spheres(
        self, q: Float[Tensor, "*batch dof"]
    ) -> tuple[Float[Tensor, "*batch s 3"], Float[Tensor, " s"]]:
        """Sphere centres [m, world frame], differentiable by autograd, and radii [m] at configurations q."""
        ...


@runtime_checkable
class LinkedRobot(SphereRobot, Protocol):
    """A robot that names the link each sphere belongs to."""

    @property
    def sphere_links(self) -> tuple[str, ...]:
        """(s,) link names, one a sphere."""
        ...


@runtime_checkable
class SelfCollidingRobot(SphereRobot, Protocol):
    """A robot with parts that can touch each other."""

    @property
    def self_collision_pairs(self) -> Int[Tensor, "p 2"]:
        """Pairs of sphere indices that must not touch."""
        ...


@runtime_checkable
class FloorRobot(SphereRobot, Protocol):
    """A robot some of whose links drive on the floor z = 0, which is part of every mapped field."""

    @property
    def floor_spheres(self) -> Bool[Tensor, " s"]:
        """True for spheres that may touch the floor (and nothing else)."""
        ...


@runtime_checkable
class CompilableRobot(LinkedRobot, Protocol):
    """A robot that lays its kinematics and its exact shape open, so that planning can compile them."""

    @property
    def chain(self) -> Any:
        """The moving joints, parents first: arrays parent, origin, axis, prismatic, column, multiplier and offset.

        Joint j carries frame j + 1, frame 0 is the root; frame j + 1 is `origin[j]` in its parent followed by a turn
        [rad] about (or slide [m] along) `axis[j]` by `multiplier[j] * q[column[j]] + offset[j]`.
        """
        ...

    @property
    def placed_spheres(self) -> tuple[Int[ndarray, " s"], Float[ndarray, "s 4"]]:
        """Of every sphere, in the order of `spheres`: its frame, and its centre there with its radius [m]."""
        ...

    def fine_spheres(self) -> tuple[Int[ndarray, " m"], Float[ndarray, "m 4"], Int[ndarray, " m"]]:
        """The same for a cover so fine that it decides what collides, and the link of each, grouped by links."""
        ...

    @property
    def link_pairs(self) -> Int[ndarray, "p 2"]:
        """Pairs of those links that must not touch."""
        ...


@runtime_checkable
class CompilableField(DistanceField, Protocol):
    """A field of boxes, cylinders and balls, or of a voxel grid, that lays them open as arrays."""

    @property
    def solids(self) -> Any:
        """Arrays kind (0 box, 1 cylinder, 2 ball), turn (world to solid), centre and size; grid, low and voxel."""
        ...
