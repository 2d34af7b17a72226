"""Where on the floor a disc-shaped base fits, and which of those places are joined."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from robots.simulation.primitives import Primitive
from robots.simulation.scene_sdf import SceneField


@dataclass(frozen=True)
class FloorMap:
    """Clearance of vertical columns over a grid of floor positions.

    Attributes:
        x: grid positions along x (nx,) [m].
        y: grid positions along y (ny,) [m].
        clearance: distance from each column to the nearest solid (nx, ny) [m]; the floor does not count.
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


def column_clearance(
    field: SceneField, positions: np.ndarray, height: float = 1.5, step: float = 0.1
) -> np.ndarray:
    """Distance [m] from vertical columns at floor positions (n, 2) to the nearest solid of the field.

    The columns go from `step` to `height` [m]. Sampling at `step` overestimates a clearance d by at most
    step**2 / (8 d): 2.5 mm at half a metre.
    """
    z = torch.arange(step, height + 1e-9, step, dtype=torch.float32)
    xy = torch.as_tensor(positions, dtype=torch.float32)
    columns = torch.cat((xy[:, None].expand(-1, len(z), 2), z[None, :, None].expand(len(xy), -1, 1)), dim=-1)
    with torch.no_grad():
        return field.distance(columns).amin(dim=-1).numpy()


def floor_map(
    primitives: Iterable[Primitive], width: float, depth: float, resolution: float = 0.05
) -> FloorMap:
    """Map the clearance over the floor |x| < width / 2, |y| < depth / 2 [m] of a scene without its floor."""
    field = SceneField([p for p in primitives if p.name != "floor"])
    x = np.arange(-width / 2 + resolution / 2, width / 2, resolution)
    y = np.arange(-depth / 2 + resolution / 2, depth / 2, resolution)
    positions = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return FloorMap(x, y, column_clearance(field, positions).reshape(len(x), len(y)))
