"""The distance field of a voxel map whose distances stand at the voxel centres."""

from __future__ import annotations

import functools

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ..display import ShownField
from ..field import GridField, check_points
from .nearest_seed import observed_at


class VoxelField(ShownField):
    """Trilinear distances between voxel centres, and what of them was observed; immutable.

    Where a distance is NaN the value of the nearest voxel that has one stands in, as in the paper's evaluation of
    Voxblox; such voxels have confidence 0. Outside the grid the value is that of its closest point.

    Args:
        values: distances at the voxel centres [m], NaN where the map has none.
        observed: of the same shape; NaN values are never observed.
        origin: (3,) world position of values[0, 0, 0] [m].
        voxel: edge of a voxel [m].
        bounds: (2, 3) lower and upper corner of what was observed [m].
    """

    def __init__(
        self,
        values: Float[Tensor, "nx ny nz"],
        observed: Bool[Tensor, "nx ny nz"],
        origin: Float[Tensor, "3"],
        voxel: float,
        bounds: Float[Tensor, "2 3"],
    ) -> None:
        self._values, self._observed = values, observed
        self._origin, self._voxel, self.bounds = origin.clone(), float(voxel), bounds.clone()

    @property
    def nbytes(self) -> int:
        """Memory of the distances and of what was observed [bytes], without the copy that a query makes once."""
        return self._values.nbytes + self._observed.nbytes

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distance [m] at world points [m], positive outside; differentiable by autograd."""
        return self._grid.distance(points)

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] and the gradient of its interpolant; no autograd graph."""
        return self._grid.distance_and_gradient(points)

    def confidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """1 where the voxel of a world point [m] was observed, 0 elsewhere."""
        check_points(points)
        return observed_at(self._observed, self._origin, self._voxel, points)

    @functools.cached_property
    def _grid(self) -> GridField:
        # Only who asks for distances pays for the filling: while mapping, most snapshots are never looked at.
        values, missing = self._values, self._values.isnan()
        if bool(missing.any()):
            nearest = distance_transform_edt(missing.numpy(), return_distances=False, return_indices=True)
            values = values[tuple(torch.from_numpy(i).long() for i in nearest)]
        return GridField(values, self._origin, self._voxel)
