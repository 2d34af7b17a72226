"""A dense voxel volume that grows with what the camera sees."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ..errors import ConfigError, FrameError
from ..extent import fits
from ..frames import DepthFrame

# The volume grows by whole blocks of this edge [voxels], so that it is seldom moved.
GROWTH = 16


# Four times the methods' own limits; with what rebuilding takes, some gigabytes.
MOST_VOXELS = 1 << 28


class GrowingVolume:
    """Named channels over one box of voxels, whose lattice is fixed to the world's origin.

    Voxel (i, j, k) of the lattice has its centre at voxel * (i, j, k) [m]; array index 0 is lattice index `corner`.

    Args:
        voxel: edge of a voxel [m].
        channels: names and types; all start at zero.
        max_voxels: growth beyond this many is refused.

    Raises:
        ConfigError: the voxel size or the limit is not positive.
    """

    def __init__(self, voxel: float, channels: Mapping[str, type[np.generic]], max_voxels: int) -> None:
        if max_voxels > MOST_VOXELS:
            raise ConfigError(
                f"max_voxels must be at most {MOST_VOXELS}, got {max_voxels}: memory ends before"
            )
        if not (np.isfinite(voxel) and voxel > 0) or max_voxels < 1:
            raise ConfigError(
                f"voxel must be a positive edge in metres and max_voxels positive, got {voxel} and {max_voxels}"
            )
        self.voxel, self.max_voxels = float(voxel), int(max_voxels)
        self.corner = np.zeros(3, dtype=np.int64)
        self.channels = {name: np.zeros((0, 0, 0), dtype=kind) for name, kind in channels.items()}

    @property
    def shape(self) -> tuple[int, ...]:
        """Voxels an axis."""
        return next(iter(self.channels.values())).shape

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """Centre of voxel (0, 0, 0) of the arrays [m]."""
        return self.corner * self.voxel

    @property
    def nbytes(self) -> int:
        """Memory of all channels [bytes]."""
        return sum(channel.nbytes for channel in self.channels.values())

    def include(self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]) -> None:
        """Grow so that the world box [m] lies inside; what is stored stays where it is in the world.

        Raises:
            FrameError: that would take more than `max_voxels`; nothing has changed.
        """
        low = np.floor(lower / self.voxel / GROWTH) * GROWTH
        high = np.ceil((upper / self.voxel + 1) / GROWTH) * GROWTH
        if 0 not in self.shape:
            low = np.minimum(low, self.corner)
            high = np.maximum(high, self.corner + self.shape)
        size = high - low
        if np.array_equal(size, self.shape):
            return
        if not fits(low, high, self.max_voxels):
            raise FrameError(
                f"this frame would make the map {' x '.join(f'{s * self.voxel:.1f}' for s in size)} m, more than "
                f"max_voxels = {self.max_voxels} of {self.voxel} m; if its pose is right, choose a larger voxel or "
                "a smaller max_depth"
            )
        first, size = low.astype(np.int64), size.astype(np.int64)
        offset = self.corner - first
        inner = tuple(slice(o, o + n) for o, n in zip(offset, self.shape, strict=True))
        for name, old in self.channels.items():
            new = np.zeros(tuple(size), dtype=old.dtype)
            if old.size:
                new[inner] = old
            self.channels[name] = new
        self.corner = first

    def include_frame(
        self, frame: DepthFrame, reach: Float[np.ndarray, "h w"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Grow to hold the camera and every ray up to `reach` [m, z-depth, 0 = no ray]; returns first and last
        array index of that box."""
        camera, T = frame.camera, frame.T_world_camera.numpy()
        v, u = np.nonzero(reach > 0)
        z = reach[v, u]
        # One row an axis: extremes along rows are many times faster than along columns.
        points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
        points = T[:3, :3] @ points + T[:3, 3:]
        lower = np.minimum(points.min(axis=1), T[:3, 3])
        upper = np.maximum(points.max(axis=1), T[:3, 3])
        self.include(lower, upper)
        begin = np.floor((lower - self.origin) / self.voxel).astype(int)
        end = np.ceil((upper - self.origin) / self.voxel).astype(int) + 1
        return begin, np.minimum(end, self.shape)


def usable_depth(frame: DepthFrame, max_depth: float) -> Float[np.ndarray, "h w"]:
    """The frame's z-depth [m], 0 where invalid or beyond `max_depth` [m].

    Raises:
        FrameError: nothing is left.
    """
    depth = frame.depth.cpu().numpy()
    depth = np.where(depth <= max_depth, depth, 0.0)
    if not depth.any():
        raise FrameError(
            f"no pixel of the frame is within max_depth = {max_depth} m; raise it, or skip this frame"
        )
    return depth
