"""Surface meshes of simulated bodies, and the casting of rays against them with Embree."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pybullet
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float32

from robots.simulation.poses import pose_matrix

logger = logging.getLogger(__name__)


class RayCaster:
    """Nearest hits of rays with one triangle mesh, in the mesh's own frame.

    Args:
        mesh: triangles [m].
    """

    def __init__(self, mesh: trimesh.Trimesh):
        self.centre = mesh.bounds.mean(axis=0)
        """Middle of the bounding box (3,) [m]."""
        self.radius = float(np.linalg.norm(mesh.vertices - self.centre, axis=1).max())
        """Radius of a ball about `centre` that holds the mesh [m]."""
        # Embree computes in float32: vertices and origins near zero keep their precision.
        self._scene = EmbreeScene()
        TriangleMesh(
            self._scene,
            np.ascontiguousarray(mesh.vertices - self.centre, dtype=np.float32),
            np.ascontiguousarray(mesh.faces, dtype=np.int32),
        )

    def cast(
        self, origin: Float[np.ndarray, " 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Float32[np.ndarray, " n"]:
        """Multiples of the directions (of any length) at which rays from `origin` hit; inf for a miss."""
        origins = np.broadcast_to((origin - self.centre).astype(np.float32), directions.shape)
        hits = self._scene.run(
            np.ascontiguousarray(origins),
            np.ascontiguousarray(directions, dtype=np.float32),
            query="DISTANCE",
        )
        return np.where(hits < 1e30, hits, np.inf).astype(np.float32)


@dataclass(frozen=True)
class LinkSurface:
    """The drawn surface of one link of a body, in the link's URDF frame."""

    link: int
    mesh: trimesh.Trimesh


def link_surfaces(client: int, body: int) -> list[LinkSurface]:
    """Read the visual shapes of a body, one mesh for each link that has any."""
    parts: dict[int, list[trimesh.Trimesh]] = {}
    for shape in pybullet.getVisualShapeData(body, physicsClientId=client):
        link, kind, dimensions, filename, position, quaternion = shape[1:7]
        mesh = _shape_mesh(kind, dimensions, filename.decode())
        if mesh is None:
            logger.warning("link %d of body %d: visual %r cannot be drawn; left out", link, body, filename)
            continue
        parts.setdefault(link, []).append(mesh.apply_transform(pose_matrix(position, quaternion)))
    return [LinkSurface(link, joined(meshes)) for link, meshes in parts.items()]


def joined(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """All triangles of some meshes as one mesh."""
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + count for mesh, count in zip(meshes, counts, strict=False)])
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, process=False)


def _shape_mesh(kind: int, dimensions: tuple[float, ...], filename: str) -> trimesh.Trimesh | None:
    if kind == pybullet.GEOM_MESH:
        try:
            mesh = trimesh.load_mesh(filename, process=False)
        except (OSError, ValueError) as error:
            logger.warning("cannot read mesh %s: %s", filename, error)
            return None
        return mesh.apply_scale(dimensions)
    if kind == pybullet.GEOM_BOX:
        return trimesh.creation.box(extents=dimensions)
    if kind == pybullet.GEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=4, radius=dimensions[0])
    if kind in (pybullet.GEOM_CYLINDER, pybullet.GEOM_CAPSULE) and dimensions[0] > 0:
        create = trimesh.creation.cylinder if kind == pybullet.GEOM_CYLINDER else trimesh.creation.capsule
        mesh = create(height=dimensions[0], radius=dimensions[1])
        # trimesh stands its capsules on the origin in some versions: centre both alike.
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return None
