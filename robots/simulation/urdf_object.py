"""Things to handle that come as URDFs with meshes, such as those of the YCB set."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pybullet
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from robots.errors import SceneError
from robots.simulation.mesh_sdf import MeshField
from robots.simulation.poses import inverse_pose, link_frames, pose_matrix
from robots.simulation.primitives import Primitive
from robots.simulation.ray_casting import joined, link_surfaces


@dataclass(frozen=True, eq=False)
class UrdfObject(Primitive):
    """A movable object; the origin of `pose` is its centre of mass, as in the physics. See `load_object`.

    Its mass and friction are those of its URDF.
    """

    urdf_path: Path
    surface: trimesh.Trimesh
    """What is seen of it, in its own frame [m]."""
    kind: ClassVar[str] = "urdf"

    @property
    def parameters(self) -> tuple[float, float, float]:
        """Edge lengths of the box round the surface [m]."""
        x, y, z = np.ptp(self.surface.bounds, axis=0).tolist()
        return x, y, z

    @property
    def bounding_radius(self) -> float:
        """Distance from the origin to the farthest corner [m]."""
        return float(np.linalg.norm(self.surface.vertices, axis=1).max())

    def local_mesh(self) -> trimesh.Trimesh:
        """The surface."""
        return self.surface.copy()

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distance [m] of world points to the surface."""
        return self._field.distance(self._to_local(points))

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] of world points and its unit gradient."""
        distance, gradient = self._field.distance_and_gradient(self._to_local(points))
        return distance, gradient @ torch.tensor(self.pose[:3, :3], dtype=points.dtype).T

    @functools.cached_property
    def _field(self) -> MeshField:
        return MeshField(self.surface)


def load_object(path: str | Path, name: str | None = None) -> UrdfObject:
    """Read an object of one link, with its mass.

    Args:
        path: a URDF, or a folder with one.
        name: what to call it; by default as its folder.

    Raises:
        SceneError: there is no such URDF, it has no mass or nothing to see, or pybullet cannot load it.
    """
    path = Path(path)
    found = sorted(path.glob("*.urdf")) if path.is_dir() else [path]
    if len(found) != 1 or not found[0].is_file():
        raise SceneError(f"{path}: expected one .urdf file or a folder with one, found {len(found)} in it")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(found[0]), physicsClientId=client)
        mass = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[0]
        surfaces = [s for s in link_surfaces(client, body) if s.link == -1]
        # The frame of the link, in that of the centre of mass.
        centre = pose_matrix(*pybullet.getBasePositionAndOrientation(body, physicsClientId=client))
        T_centre_link = inverse_pose(centre) @ link_frames(client, body, [-1])[0]
    except pybullet.error as error:
        raise SceneError(f"pybullet cannot load {found[0]}: {error}; check its mesh paths") from error
    finally:
        pybullet.disconnect(physicsClientId=client)
    if mass <= 0 or not surfaces:
        raise SceneError(f"{found[0]}: an object needs a mass (has {mass:g} kg) and a visual shape")
    surface = joined([s.mesh for s in surfaces]).apply_transform(T_centre_link)
    return UrdfObject(name or found[0].parent.name, np.eye(4), found[0].resolve(), surface, mass=float(mass))
