"""A distance field that measures to the nearest of many small surface patches."""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..errors import ConfigError
from ..field import AnalyticField, check_points

# Points a block: the eight candidates of each stay in the processor's cache.
QUERY_BLOCK = 8192
# Share of a cell's interpolation weight that must be observed for the TSDF there to be believed.
KNOWN_SHARE = 0.25


class NearestSeedField(AnalyticField):
    """Signed distance to surface patches: discs of one radius around surface points, facing along their normals.

    The candidates for a point are the nearest seeds of the eight grid points around it, so that distances are
    measured to the surface and not interpolated. A grid point's nearest seed was chosen by the voxels that hold the
    seeds, so the distance is to the nearest of all to within a fraction of a voxel (in rooms a millimetre in the
    mean), never less. The sign is the interpolated TSDF's. Where that is within half a
    voxel of zero or unobserved, the side of the nearest patch decides. Outside the grid the candidates are those of
    its closest cell. Immutable: the tensors must not be changed by their owner.

    Args:
        nearest: (nx, ny, nz) index of the nearest seed of every grid point.
        seeds: (n, 3) surface points [m].
        normals: (n, 3) unit vectors out of the surface.
        signed: (nx, ny, nz) truncated signed distances [m], NaN where nothing was observed.
        origin: (3,) world position of grid point (0, 0, 0) [m].
        voxel: distance of grid points [m].
        patch: radius of the discs [m]; 0 measures to the points alone.
        bounds: (2, 3) lower and upper corner of what was observed [m].

    Raises:
        ConfigError: there is no seed, or fewer than two grid points an axis.
    """

    def __init__(
        self,
        nearest: Int[Tensor, "nx ny nz"],
        seeds: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
        signed: Float[Tensor, "nx ny nz"],
        origin: Float[Tensor, "3"],
        voxel: float,
        patch: float,
        bounds: Float[Tensor, "2 3"],
    ) -> None:
        if len(seeds) == 0 or min(nearest.shape) < 2:
            raise ConfigError(
                f"a nearest-seed field needs a seed and two grid points an axis, got {len(seeds)} seeds on a grid of "
                f"{tuple(nearest.shape)}"
            )
        self.bounds = bounds.clone()
        self._nearest, self._signed = nearest.contiguous(), signed.contiguous()
        self._seeds, self._normals, self._origin = seeds, normals, origin.clone()
        self._voxel, self._patch = float(voxel), float(patch)
        self._sizes = torch.tensor(nearest.shape)
        self._strides = torch.tensor(self._nearest.stride())
        self._cell = torch.tensor(list(itertools.product((0, 1), repeat=3)))

    @property
    def nbytes(self) -> int:
        """Memory of all tensors [bytes]."""
        return sum(t.nbytes for t in (self._nearest, self._signed, self._seeds, self._normals))

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] and the unit vector it grows along at world points [m]; no autograd graph."""
        check_points(points)
        flat = points.detach().reshape(-1, 3).to(self._seeds)
        with torch.no_grad():
            parts = [self._answer(block) for block in flat.split(QUERY_BLOCK)]
        distance = torch.cat([p[0] for p in parts] or [flat[:, 0]])
        gradient = torch.cat([p[1] for p in parts] or [flat])
        return distance.to(points).view(points.shape[:-1]), gradient.to(points).view(points.shape)

    def confidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """1 where the voxel of a world point [m] was observed, 0 elsewhere."""
        check_points(points)
        return observed_at(~self._signed.isnan(), self._origin, self._voxel, points)

    def _answer(self, points: Tensor) -> tuple[Tensor, Tensor]:
        place = (points - self._origin) / self._voxel
        low = torch.minimum(place.floor().long().clamp(min=0), self._sizes - 2)
        corners = ((low[:, None] + self._cell) * self._strides).sum(dim=-1)
        arm, height, normal = self._nearest_patch(points, self._nearest.view(-1)[corners].long())
        tsdf = self._interpolate(self._signed.view(-1)[corners], (place - low).clamp(0, 1))
        side = torch.where(tsdf.abs() > 0.5 * self._voxel, tsdf, height)
        sign = torch.where(side < 0, -1.0, 1.0)
        distance = arm.norm(dim=-1)
        # On the patch itself the direction to it is lost, but its normal is the limit from both sides.
        touching = distance < 1e-4 * self._voxel
        direction = sign[:, None] * arm / distance.clamp(min=1e-12)[:, None]
        return sign * distance, torch.where(touching[:, None], normal, direction)

    def _nearest_patch(self, points: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Vector from the closest patch to the point [m], height above its plane [m], and its normal."""
        offset, normal = points[:, None] - self._seeds[candidates], self._normals[candidates]
        height = (offset * normal).sum(dim=-1, keepdim=True)
        across = offset - height * normal
        length = across.norm(dim=-1, keepdim=True)
        arm = height * normal + across * ((length - self._patch).clamp(min=0) / length.clamp(min=1e-12))
        best = arm.square().sum(dim=-1).argmin(dim=1)[:, None, None]
        chosen = [t.take_along_dim(best, dim=1)[:, 0] for t in (arm, height, normal)]
        return chosen[0], chosen[1][:, 0], chosen[2]

    def _interpolate(self, values: Tensor, t: Tensor) -> Tensor:
        """Trilinear TSDF [m] of the observed among the 8 corners; 0 where too little was observed."""
        weight = torch.where(self._cell.bool(), t[:, None], 1 - t[:, None]).prod(dim=-1)
        weight = weight * ~values.isnan()
        total = weight.sum(dim=-1)
        mean = (weight * values.nan_to_num()).sum(dim=-1) / total.clamp(min=KNOWN_SHARE)
        return torch.where(total >= KNOWN_SHARE, mean, torch.zeros_like(mean))


def observed_at(
    observed: Bool[Tensor, "nx ny nz"],
    origin: Float[Tensor, "3"],
    voxel: float,
    points: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch"]:
    """1 where the voxel that holds a world point [m] is flagged, 0 elsewhere and outside the grid."""
    place = ((points.detach() - origin.to(points)) / voxel).round()
    sizes = torch.tensor(observed.shape)
    inside = ((place >= 0) & (place < sizes)).all(dim=-1)
    i, j, k = torch.where(inside[..., None], place, torch.zeros_like(place)).long().unbind(dim=-1)
    return (inside & observed[i, j, k]).to(points.dtype)
