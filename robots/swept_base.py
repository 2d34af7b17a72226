"""A turning mobile base as a robot with two degrees of freedom: what its posture sweeps when it turns."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from robots.errors import RobotError, UnknownJointError
from robots.model import Robot
from robots.urdf import BASE_JOINTS


class SweptBase:
    """The spheres of a fixed posture at many headings about the base axis, to be translated by (x, y).

    A path planned for this body is free of collision for a differential-drive base whatever its heading,
    so that it may turn on the spot anywhere along the path. Satisfies the planner's `SphereRobot` protocol
    with q = base_x, base_y [m].

    Args:
        robot: a robot with the planar base joints base_x, base_y and base_yaw among its planned joints.
        q: the posture (dof,) to hold; its base_x, base_y and base_yaw do not matter.
        max_spheres: bound on the number of spheres; fewer headings are used, with larger spheres, to keep it.

    Spheres are enlarged by what a heading between two samples moves them, so the cover has no gaps, and
    spheres inside others are dropped. Raises `UnknownJointError` where the base joints are missing and
    `RobotError` where `max_spheres` cannot be kept.
    """

    def __init__(self, robot: Robot, q: Float[Tensor, " dof"], max_spheres: int = 250) -> None:
        missing = [joint for joint in BASE_JOINTS if joint not in robot.joint_names]
        if missing:
            raise UnknownJointError(f"{robot.name!r} does not plan {missing}; a swept base needs {BASE_JOINTS}")
        columns = [robot.joint_names.index(joint) for joint in BASE_JOINTS]
        posture = q.detach().clone()
        posture[columns] = 0.0
        centres, radii = robot.spheres(posture)
        rows = np.column_stack([centres.double().numpy(), radii.double().numpy()])
        swept, origin = _sweep_within(rows, max_spheres)
        self.num_dofs = 2
        self.joint_names: tuple[str, ...] = BASE_JOINTS[:2]
        self.joint_limits: Float[Tensor, "2 2"] = robot.joint_limits[columns[:2]]
        self.velocity_limits: Float[Tensor, "2"] = robot.velocity_limits[columns[:2]]
        self.sphere_links: tuple[str, ...] = tuple(robot.sphere_links[i] for i in origin)
        self.floor_spheres: Bool[Tensor, " spheres"] = robot.floor_spheres[torch.as_tensor(origin)]
        self.self_collision_pairs: Int[Tensor, "0 2"] = torch.empty((0, 2), dtype=torch.long)
        self._centres = torch.as_tensor(swept[:, :3]).to(q)
        self._radii = torch.as_tensor(swept[:, 3]).to(q)

    def spheres(
        self, q: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch spheres 3"], Float[Tensor, " spheres"]]:
        """Spheres of the turning base at positions q [m]: centres [m, world] and radii [m], differentiable.

        Raises `RobotError` if q is not (..., 2) or not finite.
        """
        if q.shape[-1:] != (2,):
            raise RobotError(f"q has shape {tuple(q.shape)}, expected (..., 2): {self.joint_names}")
        if not torch.isfinite(q).all():
            raise RobotError(f"q is NaN or infinite; expected finite {self.joint_names}")
        shift = torch.cat([q, torch.zeros_like(q[..., :1])], dim=-1)
        return self._centres.to(q) + shift[..., None, :], self._radii.to(q)


def _sweep_within(rows: np.ndarray, max_spheres: int) -> tuple[np.ndarray, np.ndarray]:
    """The finest sweep (spheres (n, 4), index of the sphere each came from) with at most `max_spheres`."""
    # Enlargement at the rim that a sweep is allowed to add, from fine to coarse.
    for slack in (0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.09, 0.15):
        swept, origin = _sweep(rows, slack)
        if len(swept) <= max_spheres:
            return swept, origin
    raise RobotError(f"the swept posture needs {len(swept)} spheres, more than max_spheres={max_spheres}; raise it")


def _sweep(rows: np.ndarray, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """Replace each sphere by a ring of spheres that covers the torus it sweeps, protruding at most `slack` [m]."""
    parts, origins = [], []
    for i, (x, y, z, radius) in enumerate(rows):
        arm = float(np.hypot(x, y))
        # One sphere on the axis does where it protrudes no more than the slack.
        if arm <= slack:
            parts.append(np.array([[0.0, 0.0, z, radius + arm]]))
            origins.append([i])
            continue
        # Half the angle between headings turns a centre by a chord of at most the slack.
        count = int(np.ceil(np.pi / (2 * np.arcsin(min(1.0, slack / (2 * arm))))))
        heading = np.arctan2(y, x) + 2 * np.pi * np.arange(count) / count
        chord = 2 * arm * np.sin(np.pi / (2 * count))
        ring = np.column_stack([arm * np.cos(heading), arm * np.sin(heading)])
        parts.append(np.column_stack([ring, np.full(count, z), np.full(count, radius + chord)]))
        origins.append([i] * count)
    return _pruned(np.concatenate(parts), np.concatenate([np.array(o) for o in origins]))


def _pruned(spheres: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop every sphere that lies inside another one."""
    order = np.argsort(-spheres[:, 3], kind="stable")
    spheres, origin = spheres[order], origin[order]
    kept: list[int] = []
    for i, sphere in enumerate(spheres):
        gap = np.linalg.norm(spheres[kept, :3] - sphere[:3], axis=1) + sphere[3] - spheres[kept, 3]
        if not (gap <= 1e-9).any():
            kept.append(i)
    return spheres[kept], origin[kept]
