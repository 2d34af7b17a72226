"""Boxes, cylinders and spheres: the solids a scene is made of, with their exact signed distances."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeAlias

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from robots.errors import SceneError

Colour: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Primitive:
    """A named rigid solid; the subclass gives the shape, centred on the origin of `pose`."""

    name: str
    pose: np.ndarray
    """T_world_body (4, 4) [m]."""
    colour: Colour = field(default=(0.7, 0.7, 0.7), kw_only=True)
    mass: float = field(default=0.0, kw_only=True)
    """[kg]; 0 makes the solid static."""
    friction: float = field(default=0.8, kw_only=True)
    """Lateral friction coefficient; the simulator multiplies those of the two touching bodies."""

    kind: ClassVar[str]

    def __post_init__(self) -> None:
        pose = np.array(self.pose, dtype=np.float64)
        if pose.shape != (4, 4) or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6):
            raise SceneError(f"{self.name}: pose must be a rigid (4, 4) transform, got shape {pose.shape}")
        if min(self.parameters) <= 0:
            raise SceneError(f"{self.name}: sizes must be positive [m], got {self.parameters}")
        if self.mass < 0:
            raise SceneError(f"{self.name}: mass must be 0 (static) or positive [kg], got {self.mass}")
        pose.setflags(write=False)
        object.__setattr__(self, "pose", pose)

    @property
    def parameters(self) -> tuple[float, float, float]:
        """Three shape parameters as `local_distance` of the kind takes them [m]."""
        raise NotImplementedError

    @property
    def bounding_radius(self) -> float:
        """Radius of the smallest ball round the centre that holds the solid [m]."""
        raise NotImplementedError

    def local_mesh(self) -> trimesh.Trimesh:
        """Surface mesh in the solid's own frame [m]."""
        raise NotImplementedError

    def mesh(self) -> trimesh.Trimesh:
        """Surface mesh in the world frame [m]."""
        return self.local_mesh().apply_transform(self.pose)

    def at(self, pose: np.ndarray) -> Primitive:
        """Return the same solid at another pose (4, 4)."""
        return replace(self, pose=pose)

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Exact signed distance [m] of world points, differentiable by autograd."""
        parameters = torch.tensor(self.parameters, dtype=points.dtype)
        return LOCAL_DISTANCE[self.kind](self._to_local(points), parameters)

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Exact signed distance [m] of world points and its unit gradient, in closed form."""
        parameters = torch.tensor(self.parameters, dtype=points.dtype)
        local = self._to_local(points)
        rotation = torch.tensor(self.pose[:3, :3], dtype=points.dtype)
        gradient = LOCAL_GRADIENT[self.kind](local, parameters) @ rotation.T
        return LOCAL_DISTANCE[self.kind](local, parameters), gradient

    def _to_local(self, points: Tensor) -> Tensor:
        pose = torch.tensor(self.pose, dtype=points.dtype)
        return (points - pose[:3, 3]) @ pose[:3, :3]


@dataclass(frozen=True, eq=False)
class Box(Primitive):
    """A cuboid with full edge lengths `size` [m]."""

    size: tuple[float, float, float]
    kind: ClassVar[str] = "box"

    @property
    def parameters(self) -> tuple[float, float, float]:
        """Half the edge lengths [m]."""
        return self.size[0] / 2, self.size[1] / 2, self.size[2] / 2

    @property
    def bounding_radius(self) -> float:
        """Half the space diagonal [m]."""
        return float(np.linalg.norm(self.parameters))

    def local_mesh(self) -> trimesh.Trimesh:
        """Twelve triangles about the origin."""
        return trimesh.creation.box(extents=self.size)


@dataclass(frozen=True, eq=False)
class Cylinder(Primitive):
    """A cylinder about its own z axis, `height` [m] long."""

    radius: float
    height: float
    kind: ClassVar[str] = "cylinder"

    @property
    def parameters(self) -> tuple[float, float, float]:
        """Radius and half the height [m]; the third is only filled in."""
        return self.radius, self.height / 2, 1.0

    @property
    def bounding_radius(self) -> float:
        """Distance from the centre to the rim [m]."""
        return float(np.hypot(self.radius, self.height / 2))

    def local_mesh(self) -> trimesh.Trimesh:
        """96 facets round: the flats stay within 0.06 % of the radius of the true surface."""
        return trimesh.creation.cylinder(radius=self.radius, height=self.height, sections=96)


@dataclass(frozen=True, eq=False)
class Sphere(Primitive):
    """A ball."""

    radius: float
    kind: ClassVar[str] = "sphere"

    @property
    def parameters(self) -> tuple[float, float, float]:
        """Radius [m]; the others are only filled in."""
        return self.radius, 1.0, 1.0

    @property
    def bounding_radius(self) -> float:
        """Radius [m]."""
        return self.radius

    def local_mesh(self) -> trimesh.Trimesh:
        """An icosphere of 5,120 triangles, within 0.1 % of the radius of the true surface."""
        return trimesh.creation.icosphere(subdivisions=4, radius=self.radius)


def _corner_distance(q: Tensor) -> Tensor:
    """Distance to the corner region q <= 0 (all axes): outside Euclidean, inside the nearest face."""
    outside = torch.linalg.vector_norm(q.clamp(min=0), dim=-1)
    return outside + q.amax(dim=-1).clamp(max=0)


def _corner_gradient(q: Tensor) -> Tensor:
    """Gradient of `_corner_distance` by q; at ties inside, the first of the nearest faces."""
    positive = q.clamp(min=0)
    norm = torch.linalg.vector_norm(positive, dim=-1, keepdim=True)
    face = torch.nn.functional.one_hot(q.argmax(dim=-1), q.shape[-1]).to(q.dtype)
    return torch.where(norm > 0, positive / norm.clamp(min=torch.finfo(q.dtype).tiny), face)


def _sign(x: Tensor) -> Tensor:
    """Sign that is 1 at zero, so a gradient on a plane of symmetry still has unit length."""
    return 1.0 - 2.0 * (x < 0).to(x.dtype)


def _box_distance(local: Tensor, parameters: Tensor) -> Tensor:
    return _corner_distance(local.abs() - parameters)


def _box_gradient(local: Tensor, parameters: Tensor) -> Tensor:
    return _sign(local) * _corner_gradient(local.abs() - parameters)


def _cylinder_corner(local: Tensor, parameters: Tensor) -> Tensor:
    radial = torch.linalg.vector_norm(local[..., :2], dim=-1) - parameters[..., 0]
    return torch.stack((radial, local[..., 2].abs() - parameters[..., 1]), dim=-1)


def _cylinder_distance(local: Tensor, parameters: Tensor) -> Tensor:
    return _corner_distance(_cylinder_corner(local, parameters))


def _cylinder_gradient(local: Tensor, parameters: Tensor) -> Tensor:
    corner = _corner_gradient(_cylinder_corner(local, parameters))
    radial = corner[..., :1] * _unit(local[..., :2])
    return torch.cat((radial, corner[..., 1:] * _sign(local[..., 2:])), dim=-1)


def _sphere_distance(local: Tensor, parameters: Tensor) -> Tensor:
    return torch.linalg.vector_norm(local, dim=-1) - parameters[..., 0]


def _sphere_gradient(local: Tensor, parameters: Tensor) -> Tensor:
    return _unit(local)


def _unit(x: Tensor) -> Tensor:
    """Direction of x; the first axis at the origin, where every direction is as good."""
    norm = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    first = torch.zeros_like(x)
    first[..., 0] = 1
    return torch.where(norm > 0, x / norm.clamp(min=torch.finfo(x.dtype).tiny), first)


# By kind: signed distance and gradient at points in the solid's frame. `parameters` (..., 3) broadcasts.
LOCAL_DISTANCE = {"box": _box_distance, "cylinder": _cylinder_distance, "sphere": _sphere_distance}
LOCAL_GRADIENT = {"box": _box_gradient, "cylinder": _cylinder_gradient, "sphere": _sphere_gradient}
