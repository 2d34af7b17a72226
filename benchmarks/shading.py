"""Pictures of a room's mesh from above without a display, shaded by casting rays."""

from __future__ import annotations

import math

import numpy as np
import trimesh
from jaxtyping import Float

from robots.simulation.ray_casting import RayCaster

WIDTH, HEIGHT = 380, 300
FIELD_OF_VIEW = math.radians(40)
LIGHT = np.array([-0.35, -0.55, 0.76])


def dollhouse(
    mesh: trimesh.Trimesh, room: Float[np.ndarray, "2 3"], azimuth: float = -0.9, elevation: float = 0.95
) -> Float[np.ndarray, "h w"]:
    """A grey picture of a room seen from outside and above; faces turned away, as the near walls', are left out.

    Args:
        mesh: surfaces [m], normals into free space, z up.
        room: lower and upper corner of what must be in the picture [m].
        azimuth: of the viewer as seen from the room's middle [rad].
        elevation: of the viewer above the floor [rad].
    """
    centre, radius = room.mean(axis=0), np.linalg.norm(room[1] - room[0]) / 2
    away = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    eye = centre + away * 0.95 * radius / math.sin(FIELD_OF_VIEW / 2)
    picture = np.ones((HEIGHT, WIDTH))
    if len(mesh.faces) == 0:
        return picture
    facing = ((eye - mesh.triangles_center) * mesh.face_normals).sum(axis=1) > 0
    if not facing.any():
        return picture
    seen = trimesh.Trimesh(mesh.vertices, mesh.faces[facing], process=False)
    directions = _directions(away)
    depth = RayCaster(seen).cast(eye, directions.reshape(-1, 3)).reshape(HEIGHT, WIDTH)
    points = eye + np.where(np.isfinite(depth), depth, np.nan)[..., None] * directions
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    normals *= -np.sign((normals * directions).sum(axis=-1, keepdims=True))
    shade = 0.2 + 0.72 * np.clip(normals @ LIGHT, 0, 1)
    return np.where(np.isnan(shade), picture, shade)


def _directions(away: Float[np.ndarray, "3"]) -> Float[np.ndarray, "h w 3"]:
    """Viewing rays of a camera that looks against `away`, its image's x axis level."""
    right = np.cross(-away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(-away, right)
    scale = 2 * math.tan(FIELD_OF_VIEW / 2) / HEIGHT
    u = (np.arange(WIDTH) - (WIDTH - 1) / 2) * scale
    v = (np.arange(HEIGHT) - (HEIGHT - 1) / 2) * scale
    return -away + u[None, :, None] * right + v[:, None, None] * down
