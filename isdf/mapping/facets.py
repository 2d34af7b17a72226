"""A depth image as the planes of small squares of pixels: what two views of the same walls can be compared by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

# Squares across an image.
ACROSS = 80
# On a plane the inverse depth is linear over the image: from square to square it bends by less than this [1 / m], the
# noise of a structured-light camera.
BEND = 0.003
# Least cosine between a plane's normal and the ray: along a plane seen at a glance depth says little.
STEEP = 0.3


@dataclass(frozen=True)
class Facets:
    """The squares of one image, in its camera's frame, and the pose it was taken from.

    Args:
        flat: which squares, and their neighbours, are wholly measured and on one plane that is not seen at a glance.
        inverse: inverse z-depth in their middle [1 / m].
        rays: through their middle, of z = 1.
        normals: unit normals, away from the camera.
        pose: T_world_camera.
        intrinsics: fx, fy, cx, cy [squares].
    """

    flat: Bool[np.ndarray, "h w"]
    inverse: Float[np.ndarray, "h w"]
    rays: Float[np.ndarray, "h w 3"]
    normals: Float[np.ndarray, "h w 3"]
    pose: Float[np.ndarray, "4 4"]
    intrinsics: tuple[float, float, float, float]

    @classmethod
    def of(
        cls,
        depth: Float[np.ndarray, "height width"],
        intrinsics: tuple[float, float, float, float],
        pose: Float[np.ndarray, "4 4"],
    ) -> Facets:
        """Fit them to z-depth [m], 0 where unknown; `intrinsics` are of its pixels."""
        side = max(1, depth.shape[1] // ACROSS)
        rows, columns = depth.shape[0] // side, depth.shape[1] // side
        squares = depth[: rows * side, : columns * side].reshape(rows, side, columns, side)
        measured = np.asarray((squares > 0).all(axis=(1, 3)))
        with np.errstate(divide="ignore"):
            inverse = (np.float32(1) / squares).mean(axis=(1, 3))
        inverse = np.where(measured, inverse, np.float32(0))
        fx, fy, cx, cy = intrinsics
        scaled = (fx / side, fy / side, (cx + 0.5) / side - 0.5, (cy + 0.5) / side - 0.5)
        x, y = (np.arange(columns) - scaled[2]) / scaled[0], (np.arange(rows) - scaled[3]) / scaled[1]
        rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)
        down, right = (_middle_difference(inverse, axis) for axis in (0, 1))
        # A plane n . p = c has the inverse depth n . ray / c.
        normals = np.empty(rays.shape)
        normals[..., 0], normals[..., 1] = right * scaled[0], down * scaled[1]
        normals[..., 2] = inverse - normals[..., 0] * rays[..., 0] - normals[..., 1] * rays[..., 1]
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
        facing = np.einsum("hwk,hwk->hw", normals, rays) > STEEP * np.linalg.norm(rays, axis=-1)
        return cls(_flat(measured, inverse) & facing, inverse, rays, normals, pose, scaled)


def _middle_difference(values: Float[np.ndarray, "h w"], axis: int) -> Float[np.ndarray, "h w"]:
    """Slope by both neighbours, 0 at the rim."""
    moved = np.moveaxis(values, axis, 0)
    out = np.zeros(moved.shape)
    out[1:-1] = (moved[2:] - moved[:-2]) / 2
    return np.moveaxis(out, 0, axis)


def _flat(measured: Bool[np.ndarray, "h w"], inverse: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where a square and the eight around it are measured and on one plane; never at the rim."""
    out = np.zeros(measured.shape, dtype=bool)
    inner = (slice(1, -1), slice(1, -1))
    h, w = measured.shape
    around = [(slice(1 + i, h - 1 + i), slice(1 + j, w - 1 + j)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    out[inner] = np.all([measured[part] for part in around], axis=0)
    for part, opposite in zip(around[:4], around[:4:-1], strict=True):
        out[inner] &= np.abs(inverse[part] + inverse[opposite] - 2 * inverse[inner]) < BEND
    return out
