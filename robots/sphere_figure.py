"""Picture of a robot's collision geometry with its spheres."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from torch import Tensor

from robots.link_geometry import collision_pieces
from robots.model import Robot

VIEWS = ((15, -60), (15, 30))  # elevation and azimuth [deg]
HULL_COLOUR, SPHERE_COLOUR = "0.35", "tab:orange"


class RobotFigure(Figure):
    """A figure that notebooks show inline, whether or not pyplot was imported."""

    def _repr_png_(self) -> bytes:
        data = io.BytesIO()
        self.savefig(data, format="png", dpi=70)
        return data.getvalue()


def save_sphere_figure(path: str | Path, robot: Robot, q: Tensor | None = None) -> None:
    """Write the picture of `sphere_figure`."""
    sphere_figure(robot, q).savefig(path, dpi=110)


def sphere_figure(robot: Robot, q: Tensor | None = None) -> RobotFigure:
    """Draw hulls (grey), then hulls with spheres (orange), from two sides, at q (dof,) or at rest."""
    q = robot.rest if q is None else q
    poses = robot.tree.link_transforms(robot.joint_values(q))
    hulls = [
        piece.copy().apply_transform(poses[link]).triangles
        for link, pieces in collision_pieces(robot.urdf_path).items()
        for piece in pieces
    ]
    centres, radii = robot.spheres(q)
    ball = trimesh.creation.icosphere(subdivisions=1)
    spheres = [ball.triangles * float(r) + c for c, r in zip(centres.numpy(), radii, strict=True)]
    figure = RobotFigure(figsize=(11, 12), layout="constrained")
    for row, (elevation, azimuth) in enumerate(VIEWS):
        for extra in (0, 1):
            axes = figure.add_subplot(2, 2, 2 * row + extra + 1, projection="3d")
            assert isinstance(axes, Axes3D)
            axes.view_init(elevation, azimuth)
            axes.computed_zorder = False  # or whole collections hide one another: spheres go on top
            _draw(axes, hulls, HULL_COLOUR, 1.0, 1)
            if extra:
                _draw(axes, spheres, SPHERE_COLOUR, 0.15, 2)
            axes.set_title(f"{len(radii)} spheres" if extra else "convex hulls", fontsize=10)
            _fit_axes(axes, np.concatenate([part.reshape(-1, 3) for part in hulls + spheres]))
    figure.suptitle(robot.name)
    return figure


def _draw(axes: Axes3D, parts: list[np.ndarray], colour: str, opacity: float, order: int) -> None:
    triangles = np.concatenate(parts)
    axes.add_collection3d(
        Poly3DCollection(triangles, facecolors=colour, alpha=opacity, shade=True, zorder=order)
    )


def _fit_axes(axes: Axes3D, points: np.ndarray) -> None:
    low, high = points.min(0), points.max(0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.tick_params(labelsize=6)
