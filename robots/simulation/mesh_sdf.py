"""The exact signed distance field of triangle meshes: the ground truth of scenes that are not made of primitives."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from robots.errors import SceneError
from robots.kinematic_tree import KinematicTree
from robots.link_geometry import collision_pieces
from robots.simulation.ray_casting import joined
from robots.simulation.triangle_tree import build, signed_distances


class MeshField:
    """Signed distance to the union of what meshes enclose, exact to rounding, at 2 to 20 us a point.

    Every closed part of a mesh is a solid of its own, so a table may be made of a board and legs that overlap; in the
    overlap the magnitude is a lower bound. A closed part whose triangles face inwards is a hollow: a room. Parts with
    holes, such as scans, count as one surface, and outside is where the nearest triangle faces. Conforms to the
    `DistanceField` protocol. Immutable.

    Args:
        meshes: one or several [m, world].

    Attributes:
        bounds: (2, 3) lower and upper corner of all triangles [m].

    Raises:
        SceneError: there is no triangle, or a corner is not finite.
    """

    def __init__(self, meshes: trimesh.Trimesh | Iterable[trimesh.Trimesh]) -> None:
        given = [meshes] if isinstance(meshes, trimesh.Trimesh) else list(meshes)
        if not all(np.isfinite(mesh.vertices).all() for mesh in given):
            raise SceneError(
                "a distance field needs finite vertices, and a mesh has NaN or inf among its own"
            )
        parts = [part for mesh in given for part in _parts(mesh)]
        if not parts:
            raise SceneError("a distance field needs at least one triangle of positive area; there is none")
        solids = [part for part in parts if part.is_watertight]
        sheets = [part for part in parts if not part.is_watertight]
        bodies = [*solids, *([joined(sheets)] if sheets else [])]
        closed = [bool(body.is_watertight and body.volume > 0) for body in bodies]
        self._tree = build(bodies, closed)
        corners = self._tree.corners
        self.bounds = torch.tensor(
            np.stack([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))]), dtype=torch.float32
        )

    @classmethod
    def read(
        cls, path: str | Path, T_world_mesh: Float[np.ndarray, "4 4"] | None = None, scale: float = 1.0
    ) -> MeshField:
        """The field of a mesh file of any kind that trimesh reads (ply, obj, stl, glb, off, dae).

        Args:
            path: the file.
            T_world_mesh: where the mesh stands in the world, after scaling; a glTF file has y up, worlds have z up.
            scale: metres in a unit of the file, 0.001 for millimetres.

        Raises:
            SceneError: the file is missing, cannot be read or holds no triangle.
        """
        try:
            loaded = trimesh.load(str(path), force="scene")
        except (OSError, ValueError, KeyError, IndexError, NotImplementedError) as error:
            raise SceneError(f"{path}: not a readable mesh ({error})") from error
        meshes = [m for m in loaded.dump() if isinstance(m, trimesh.Trimesh)]  # type: ignore[attr-defined]
        T = np.eye(4) if T_world_mesh is None else np.asarray(T_world_mesh, dtype=np.float64)
        try:
            return cls(mesh.apply_scale(scale).apply_transform(T) for mesh in meshes)
        except SceneError as error:
            raise SceneError(f"{path}: {error}") from error

    @classmethod
    def from_urdf(cls, path: str | Path) -> MeshField:
        """The field of a static URDF as it is collided with: hulls of its meshes, but for `<collision concave="yes">`.

        Raises:
            SceneError: it has no collision geometry.
            UrdfError: the file or a mesh it names cannot be read.
        """
        poses = KinematicTree.from_urdf(path).link_transforms({})
        pieces = collision_pieces(path, keep_concave=True)
        try:
            return cls(piece.apply_transform(poses[link]) for link, held in pieces.items() for piece in held)
        except SceneError as error:
            raise SceneError(f"{path}: {error}") from error

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distance [m] of points [m, world], positive outside; differentiable by autograd."""
        distance, gradient = self.distance_and_gradient(points)
        if not (torch.is_grad_enabled() and points.requires_grad):
            return distance
        # Zero in value, and with the gradient known in closed form.
        moved = points - points.detach()
        return distance + (gradient * moved).sum(dim=-1)

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] and its unit gradient at points [m, world], in closed form, without a graph."""
        flat = points.detach().reshape(-1, 3).double().cpu().numpy()
        if not np.isfinite(flat).all():
            raise SceneError("distances are asked at points that are NaN or inf")
        distance, gradient = signed_distances(self._tree, np.ascontiguousarray(flat))
        return (
            torch.from_numpy(distance).to(points).view(points.shape[:-1]),
            torch.from_numpy(gradient).to(points).view(points.shape),
        )


def _parts(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Connected parts of a mesh, corners in one place made one, without triangles of no area."""
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    return list(mesh.split(only_watertight=False)) if len(mesh.faces) else []
