"""Bounds on the signed distance of sampled points, with the gradient each implies (paper section 4.3).

Every bound is the distance to one surface point that is near, so its magnitude is never smaller than the true
distance's; its sign says on which side of the measured depth the sample lies.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from .sampling import RayBatch, valid_normals

BoundMethod = Literal["ray", "normal", "batch"]
Bound = tuple[Float[Tensor, "r k"], Float[Tensor, "r k 3"]]

# The plane assumption behind the normal correction is dropped beyond this distance along the ray [m].
NORMAL_REACH = 0.30
# Upper size of one block of the point-to-point table, in entries: 64 MB of float32.
TABLE_ENTRIES = 1 << 24


def ray_bound(batch: RayBatch) -> Bound:
    """Distance along the ray, D - d; the gradient points back along the ray."""
    return batch.behind, -batch.direction[:, None].expand_as(batch.points)


def normal_bound(batch: RayBatch) -> Bound:
    """Ray distance times the cosine between ray and normal, within 30 cm of the surface; the ray bound elsewhere."""
    bound, gradient = ray_bound(batch)
    usable = valid_normals(batch)
    normal = torch.nan_to_num(batch.normal)
    cosine = -(batch.direction * normal).sum(dim=-1)
    near = usable[:, None] & (bound.abs() < NORMAL_REACH)
    bound = torch.where(near, cosine[:, None] * bound, bound)
    gradient = torch.where(near[..., None], normal[:, None], gradient)
    return bound, gradient


def batch_bound(batch: RayBatch) -> Bound:
    """Distance to the closest surface point of the batch, and the vector from it (signed, not normalised).

    The set P is the surface points of all rays plus `batch.extra_surface`.
    """
    surface = torch.cat([batch.surface, batch.extra_surface])
    points = batch.points.reshape(-1, 3)
    offset = points - surface[nearest(points, surface)]
    sign = torch.where(batch.behind < 0, -1.0, 1.0).to(offset.dtype)
    offset = offset.view_as(batch.points)
    return sign * offset.norm(dim=-1), sign[..., None] * offset


def nearest(points: Float[Tensor, "n 3"], targets: Float[Tensor, "m 3"]) -> Int[Tensor, "n"]:
    """Index of the closest target of every point: by a tree on the CPU, by matrix products elsewhere."""
    if points.device.type != "cpu":
        return _nearest_by_product(points, targets)
    tree = cKDTree(targets.numpy(), balanced_tree=False, compact_nodes=False)
    return torch.from_numpy(tree.query(points.numpy())[1])


def _nearest_by_product(points: Tensor, targets: Tensor) -> Tensor:
    """In blocks that bound the memory of the table of distances."""
    centre = targets.mean(dim=0)  # small numbers keep |p|^2 - 2 x.p accurate far from the origin
    targets = targets - centre
    square = (targets * targets).sum(dim=-1)
    rows = max(1, TABLE_ENTRIES // len(targets))
    found = [
        torch.addmm(square, block - centre, targets.T, alpha=-2).min(dim=1).indices
        for block in points.split(rows)
    ]
    return torch.cat(found)


BOUNDS: dict[BoundMethod, Callable[[RayBatch], Bound]] = {
    "ray": ray_bound,
    "normal": normal_bound,
    "batch": batch_bound,
}


def supervise(batch: RayBatch, method: BoundMethod) -> Bound:
    """The bound and gradient target of every sample; surface samples get bound 0 and the measured normal.

    Where a surface sample has no normal its gradient target is zero, which the gradient loss leaves out.
    """
    bound, gradient = BOUNDS[method](batch)
    on_surface = torch.zeros_like(bound, dtype=torch.bool)
    on_surface[:, 0] = True
    normal = torch.nan_to_num(batch.normal)[:, None].expand_as(gradient)
    return (
        torch.where(on_surface, torch.zeros_like(bound), bound),
        torch.where(on_surface[..., None], normal, gradient),
    )
