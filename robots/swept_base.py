"""A turning mobile base as a robot with two degrees of freedom: what its posture sweeps when it turns."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.spatial.distance import cdist
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
        max_spheres: bound on the number of spheres; fewer and larger ones are used to keep it.

    The sweep is conservative: spheres are enlarged so that headings between two samples are covered as well.
    Raises `UnknownJointError` where the base joints are missing and
    `RobotError` where `max_spheres` cannot be kept.
    """

    def __init__(self, robot: Robot, q: Float[Tensor, " dof"], max_spheres: int = 250) -> None:
        missing = [joint for joint in BASE_JOINTS if joint not in robot.joint_names]
        if missing:
            raise UnknownJointError(
                f"{robot.name!r} does not plan {missing}; a swept base needs {BASE_JOINTS}"
            )
        columns = [robot.joint_names.index(joint) for joint in BASE_JOINTS]
        posture = q.detach().clone()
        posture[columns] = 0.0
        centres, radii = robot.spheres(posture)
        rows = np.column_stack([centres.double().numpy(), radii.double().numpy()])
        swept = _sweep_within(rows, max_spheres)
        origin = _nearest_sphere(swept, rows)
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
        self, q: Float[Tensor, "*batch dof"]
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


def _sweep_within(rows: np.ndarray, max_spheres: int) -> np.ndarray:
    """The finest sweep (n, 4) with at most `max_spheres`."""
    profile = _Profile(rows)
    # How far spheres may protrude from the swept volume [m], from fine to coarse.
    for slack in (0.015, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.12):
        spheres = profile.cover(slack)
        if len(spheres) <= max_spheres:
            return spheres
    raise RobotError(
        f"the swept posture needs {len(spheres)} spheres, more than max_spheres={max_spheres}; raise it"
    )


class _Profile:
    """The swept volume is a body of revolution: its section in the (distance from the axis, height) plane.

    There each sphere is a disc, and covering the section by few discs, each standing for a ring of spheres,
    is the same set cover as that of a link by balls.
    """

    def __init__(self, rows: np.ndarray, spacing: float = 0.006) -> None:
        discs = np.column_stack([np.hypot(rows[:, 0], rows[:, 1]), rows[:, 2], rows[:, 3]])
        # A point of the section is within half a cell's diagonal of a grid point of the section grown by that.
        self._error = spacing / np.sqrt(2)
        reach = (discs[:, 0] + discs[:, 2]).max() + 2 * spacing
        low, high = (
            (discs[:, 1] - discs[:, 2]).min() - 2 * spacing,
            (discs[:, 1] + discs[:, 2]).max() + 2 * spacing,
        )
        steps = int(np.ceil(reach / spacing))
        # Both halves of the section, so that depth near the axis is not cut off at the axis.
        across, up = np.arange(-steps, steps + 1) * spacing, np.arange(low, high, spacing)
        grid = np.stack(np.meshgrid(across, up, indexing="ij"), axis=-1)
        folded = np.stack([np.abs(grid[..., 0]), grid[..., 1]], axis=-1)
        inside = np.zeros(grid.shape[:2], dtype=bool)
        for r, z, radius in discs:
            inside |= np.hypot(folded[..., 0] - r, folded[..., 1] - z) <= radius + self._error
        depth = distance_transform_edt(inside, sampling=spacing)
        half = inside & (grid[..., 0] >= 0)
        self._points = grid[half]
        thinned = np.zeros_like(half)
        thinned[steps % 2 :: 2, ::2] = True
        self._centres, self._depths = grid[half & thinned], depth[half & thinned]
        self._gaps = cdist(self._points, self._centres)

    def cover(self, slack: float) -> np.ndarray:
        """Spheres (n, 4) that cover the swept volume and protrude at most about `slack` [m]."""
        # Half of the slack goes to the discs, half to the chord between neighbours of a ring.
        radii = self._depths + slack / 2
        counts = np.array([_ring_size(arm, slack / 2) for arm in self._centres[:, 0]])
        chosen = greedy_cover(self._gaps <= radii, gain=1.0 / counts)
        rings = []
        for (arm, z), radius, count in zip(self._centres[chosen], radii[chosen], counts[chosen], strict=True):
            heading = 2 * np.pi * np.arange(count) / count
            chord = 2 * arm * np.sin(np.pi / (2 * count))
            ring = np.column_stack([arm * np.cos(heading), arm * np.sin(heading), np.full(count, z)])
            rings.append(np.column_stack([ring, np.full(count, radius + chord + self._error)]))
        return np.concatenate(rings)


def _ring_size(arm: float, slack: float) -> int:
    """Number of headings at which a centre `arm` [m] from the axis is never farther than `slack` [m] from one."""
    if 2 * arm <= slack:
        return 1
    return int(np.ceil(np.pi / (2 * np.arcsin(min(1.0, slack / (2 * arm))))))


def _nearest_sphere(spheres: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Index (n,) of the robot's sphere whose swept ring a sphere of the sweep lies deepest in."""
    flat, discs = (np.column_stack([np.hypot(s[:, 0], s[:, 1]), s[:, 2]]) for s in (spheres, rows))
    return (cdist(flat, discs) - rows[:, 3]).argmin(1)


def greedy_cover(contains: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Columns of a boolean matrix (points, sets) that together contain every point, redundant ones removed.

    Each step takes the set with the greatest `gain` (per set) times the number of points it newly contains.
    """
    counts = contains.sum(0, dtype=np.int32)
    uncovered = np.ones(len(contains), dtype=bool)
    chosen: list[int] = []
    while uncovered.any():
        best = int(np.argmax(counts * gain))
        newly = contains[:, best] & uncovered
        chosen.append(best)
        counts -= contains[newly].sum(0, dtype=np.int32)
        uncovered &= ~newly
    times = contains[:, chosen].sum(1)
    kept = []
    for ball in chosen:
        if (times[contains[:, ball]] > 1).all():
            times = times - contains[:, ball]
        else:
            kept.append(ball)
    return np.array(kept)
