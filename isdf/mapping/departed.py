"""Whether who stood somewhere has visibly gone, though a camera sees only the upper part of who is close to it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int


def looked_past(
    place: Int[np.ndarray, "n 3"],
    seen: Bool[np.ndarray, "n"],
    edge: float,
    depth: Float[np.ndarray, "h w"],
    intrinsics: tuple[float, float, float, float],
    T_world_camera: Float[np.ndarray, "4 4"],
    axis: int,
) -> Bool[np.ndarray, "n"]:
    """In which bricks nobody stands any more: who was as tall as the camera is high, and it looks past him now.

    Args:
        place: lattice index of each brick.
        seen: in which of them something was seen that had come.
        edge: of a brick [m].
        depth: z-depth [m], 0 = unknown.
        intrinsics: fx, fy, cx, cy.
        T_world_camera: pose.
        axis: the vertical.
    """
    eye = T_world_camera[:3, 3]
    columns = np.delete(place, axis, axis=1) @ np.array([1 << 32, 1])
    tall = np.isin(columns, columns[seen & (place[:, axis] == np.floor(eye[axis] / edge))])
    middle = edge * (place + 0.5)
    middle[:, axis] = eye[axis]
    x, y, z = ((middle - eye) @ T_world_camera[:3, :3]).T
    fx, fy, cx, cy = intrinsics
    ahead = np.maximum(z, 0.05)
    u, v = (np.floor(c).astype(np.int64) for c in (x / ahead * fx + cx + 0.5, y / ahead * fy + cy + 0.5))
    past = tall & (z > 0.05) & (u >= 0) & (v >= 0) & (u < depth.shape[1]) & (v < depth.shape[0])
    past[past] = depth[v[past], u[past]] > z[past] + edge
    return past
