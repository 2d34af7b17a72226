"""Remove the robot from its own depth images, so that a map never holds the robot as an obstacle."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from robots.errors import RobotError


@runtime_checkable
class Camera(Protocol):
    """Pinhole intrinsics: focal lengths and principal point [px], pixel centres at integer coordinates."""

    @property
    def fx(self) -> float: ...  # noqa: D102

    @property
    def fy(self) -> float: ...  # noqa: D102

    @property
    def cx(self) -> float: ...  # noqa: D102

    @property
    def cy(self) -> float: ...  # noqa: D102


def remove_robot(
    depth: Float[np.ndarray, "h w"],
    camera: Camera,
    T_world_camera: Float[np.ndarray, "4 4"],
    centres: Float[np.ndarray, "s 3"] | Float[Tensor, "s 3"],
    radii: Float[np.ndarray, " radii"] | Float[Tensor, " radii"],
    margin: float = 0.03,
) -> Float[np.ndarray, "h w"]:
    """Depth image with the pixels that see the robot set to 0 (invalid).

    Args:
        depth: z-depth (h, w) [m], 0 or NaN = invalid.
        camera: pinhole intrinsics.
        T_world_camera: camera pose (4, 4) [m], OpenCV axes (x right, y down, z forward).
        centres: the robot's sphere centres (s, 3) [m, world] when the image was taken.
        radii: their radii (s,) [m].
        margin: added to the radii [m], for calibration error and delay between image and joint state.

    A pixel is removed if its back-projected point lies inside an enlarged sphere. The input is not changed.
    Raises `RobotError` for shapes that do not fit.
    """
    centres, radii = _as_numpy(centres), _as_numpy(radii)
    if centres.ndim != 2 or centres.shape[1:] != (3,) or radii.shape != centres.shape[:1] or depth.ndim != 2:
        raise RobotError(
            f"got depth {depth.shape}, centres {centres.shape}, radii {radii.shape}; expected (h, w), (s, 3), (s,)"
        )
    T_world_camera = np.asarray(T_world_camera, dtype=float)
    local = (centres - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    filtered = depth.copy()
    for (x, y, z), radius in zip(local, radii + margin, strict=True):
        box = _pixel_box(x, y, z, radius, camera, depth.shape)
        if box is None:
            continue
        rows, columns = box
        # Cull by the original image: a pixel already removed by another sphere need not be kept apart.
        seen = depth[rows, columns]
        across = (np.arange(columns.start, columns.stop) - camera.cx) / camera.fx
        down = (np.arange(rows.start, rows.stop) - camera.cy) / camera.fy
        gap = (across * seen - x) ** 2 + (down[:, None] * seen - y) ** 2 + (seen - z) ** 2
        filtered[rows, columns][(gap <= radius * radius) & (seen > 0)] = 0
    return filtered


def _pixel_box(
    x: float, y: float, z: float, radius: float, camera: Camera, shape: tuple[int, ...]
) -> tuple[slice, slice] | None:
    """Rows and columns that the sphere's image can touch; None where it is behind the camera or outside."""
    if z + radius <= 0:
        return None
    left, right = _tangent_slopes(x, z, radius)
    top, bottom = _tangent_slopes(y, z, radius)
    columns = _clipped(camera.cx + camera.fx * left, camera.cx + camera.fx * right, shape[1])
    rows = _clipped(camera.cy + camera.fy * top, camera.cy + camera.fy * bottom, shape[0])
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return None
    return rows, columns


def _tangent_slopes(lateral: float, z: float, radius: float) -> tuple[float, float]:
    """Slopes lateral / z of the two planes through the camera that touch the sphere (infinite beyond 90 degrees)."""
    distance = math.hypot(lateral, z)
    if distance <= radius:
        return -math.inf, math.inf
    middle, half = math.atan2(lateral, z), math.asin(radius / distance)
    low, high = middle - half, middle + half
    return (
        math.tan(low) if low > -math.pi / 2 else -math.inf,
        math.tan(high) if high < math.pi / 2 else math.inf,
    )


def _clipped(low: float, high: float, size: int) -> slice:
    first, last = math.floor(max(low, 0.0)) if low < size else size, math.ceil(min(high, size - 1.0))
    return slice(first, max(last + 1, 0))


def _as_numpy(values: np.ndarray | Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy() if isinstance(values, Tensor) else np.asarray(values, float)
