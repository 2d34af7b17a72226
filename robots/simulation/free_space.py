"""Where on the floor a disc-shaped base fits, and which of those places are joined."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from robots.simulation.poses import planar_pose
from robots.simulation.primitives import Box, Cylinder, Primitive
from robots.simulation.scene_sdf import SceneField

HEADROOM = 1.5
"""Solids that hang higher than this over the floor [m] are no obstacle to a base and what stands on it."""


@dataclass(frozen=True)
class FloorMap:
    """Clearance of a vertical column over a grid of floor positions.

    Attributes:
        x: grid positions along x (nx,) [m].
        y: grid positions along y (ny,) [m].
        clearance: horizontal distance from each column to the nearest solid (nx, ny) [m].
    """

    x: np.ndarray
    y: np.ndarray
    clearance: np.ndarray

    def regions(self, radius: float) -> np.ndarray:
        """Label (nx, ny) the connected sets of positions a disc of `radius` [m] fits, 0 = does not fit.

        Moving half a cell diagonal between grid points loses at most that much clearance, so the radius is
        widened by it: a labelled path is free everywhere, not only at grid points.
        """
        margin = float(np.hypot(self.x[1] - self.x[0], self.y[1] - self.y[0])) / 2
        labels, _ = ndimage.label(self.clearance >= radius + margin, structure=np.ones((3, 3)))
        return labels


def floor_map(
    primitives: Iterable[Primitive], width: float, depth: float, resolution: float = 0.05
) -> FloorMap:
    """Map the clearance over the floor |x| < width / 2, |y| < depth / 2 [m].

    What is below the floor or higher than `HEADROOM` does not count; all else counts at every height.
    """
    field = SceneField(_footprint(p) for p in primitives if _obstructs(p))
    x = np.arange(-width / 2 + resolution / 2, width / 2, resolution)
    y = np.arange(-depth / 2 + resolution / 2, depth / 2, resolution)
    points = np.stack((*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))), axis=-1)
    clearance = field.distance(torch.as_tensor(points, dtype=torch.float32)).numpy()
    return FloorMap(x, y, clearance)


def _obstructs(solid: Primitive) -> bool:
    low, high = solid.mesh().bounds[:, 2]
    return bool(high > 1e-6 and low < HEADROOM)


def _footprint(solid: Primitive) -> Primitive:
    """Prism, far taller than any room, over what an upright solid covers of the floor."""
    x, y = solid.pose[:2, 3]
    if abs(solid.pose[2, 2]) > 1 - 1e-9:
        if isinstance(solid, Box):
            yaw = float(np.arctan2(solid.pose[1, 0], solid.pose[0, 0]))
            return Box(solid.name, planar_pose(x, y, yaw=yaw), (*solid.size[:2], 100.0))
        if isinstance(solid, Cylinder):
            return Cylinder(solid.name, planar_pose(x, y), solid.radius, 100.0)
    # A leaning solid stands on the shadow of its bounding ball; for a sphere that is exact.
    return Cylinder(solid.name, planar_pose(x, y), solid.bounding_radius, 100.0)
