"""A click on an object, as a user gives it who sees the camera's image: a point of its surface, a little off."""

from __future__ import annotations

import numpy as np
import trimesh

from robots.simulation import World

OFF = 0.004
"""Standard deviation of a click along each axis [m]."""


def click_on(world: World, name: str, eye: np.ndarray, seed: int = 0) -> np.ndarray:
    """A point (3,) [m] on the side of an object that faces an eye (3,) [m].

    Clicks land near the middle of what is seen, not on its rim.
    """
    rng = np.random.default_rng([seed, 5])
    mesh = world.solids[name].local_mesh().apply_transform(world.object_pose(name))
    points, faces = trimesh.sample.sample_surface(mesh, 500, seed=int(rng.integers(2**31)))
    rays = eye - points
    facing = np.sum(mesh.face_normals[faces] * rays, axis=1) / np.linalg.norm(rays, axis=1)
    seen = points[facing > 0.3]
    middle = np.median(seen, axis=0)
    near = seen[np.argsort(np.linalg.norm(seen - middle, axis=1))[: max(1, len(seen) // 3)]]
    return near[rng.integers(len(near))] + rng.normal(0, OFF, 3)
