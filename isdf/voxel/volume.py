"""A dense voxel volume that grows with what the camera sees, and the voxels that one depth image looks at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..errors import ConfigError, FrameError
from ..frames import DepthFrame

# Voxels looked at together: their temporary arrays stay in the processor's cache.
SLAB_VOXELS = 1 << 16
# The volume grows by whole blocks of this edge [voxels], so that it is seldom moved.
GROWTH = 16
# Voxels closer to the camera than this [m] are not projected.
NEAR = 0.05


class Sight(NamedTuple):
    """Voxels that project onto measured pixels.

    Args:
        voxel: flat indices into the volume's channels.
        depth: z-depth of the voxel's centre [m].
        measured: z-depth of the surface seen in its pixel [m].
    """

    voxel: Int[np.ndarray, "n"]
    depth: Float[np.ndarray, "n"]
    measured: Float[np.ndarray, "n"]


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
        first = np.floor(lower / self.voxel / GROWTH).astype(np.int64) * GROWTH
        last = np.ceil((upper / self.voxel + 1) / GROWTH).astype(np.int64) * GROWTH
        if 0 not in self.shape:
            first = np.minimum(first, self.corner)
            last = np.maximum(last, self.corner + self.shape)
        size = last - first
        if np.array_equal(size, self.shape):
            return
        if float(np.prod(size.astype(float))) > self.max_voxels:
            raise FrameError(
                f"this frame would make the map {' x '.join(f'{s * self.voxel:.1f}' for s in size)} m, more than "
                f"max_voxels = {self.max_voxels} of {self.voxel} m; if its pose is right, choose a larger voxel or "
                "a smaller max_depth"
            )
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
        points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
        points = points @ T[:3, :3].T + T[:3, 3]
        lower = np.minimum(points.min(axis=0), T[:3, 3])
        upper = np.maximum(points.max(axis=0), T[:3, 3])
        self.include(lower, upper)
        begin = np.floor((lower - self.origin) / self.voxel).astype(int)
        end = np.ceil((upper - self.origin) / self.voxel).astype(int) + 1
        return begin, np.minimum(end, self.shape)

    def sights(
        self, frame: DepthFrame, depth: Float[np.ndarray, "h w"], begin: np.ndarray, end: np.ndarray
    ) -> Iterator[Sight]:
        """Project the centres of a box of voxels into the image, slab by slab.

        Args:
            frame: its camera and pose.
            depth: z-depth [m] with 0 where a pixel is not to be used.
            begin: first array index of the box.
            end: one past its last array index.
        """
        camera = frame.camera
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        T_camera_world = np.linalg.inv(frame.T_world_camera.numpy())
        P = K @ T_camera_world[:3]
        # Image coordinates times depth are affine in the voxel index: a sum of one vector an axis.
        start = P[:, :3] @ self.origin + P[:, 3]
        along = [
            (P[:, a, None] * (self.voxel * np.arange(begin[a], end[a]))).astype(np.float32) for a in range(3)
        ]
        along[0] = along[0] + start[:, None].astype(np.float32)
        plane = along[1][:, :, None] + along[2][:, None, :]
        image, shape = depth.astype(np.float32).ravel(), self.shape
        inner = (np.arange(begin[1], end[1])[:, None] * shape[2] + np.arange(begin[2], end[2])).ravel()
        rows = max(1, SLAB_VOXELS // inner.size)
        for x in range(0, end[0] - begin[0], rows):
            uz, vz, z = (along[0][i, x : x + rows, None, None] + plane[i] for i in range(3))
            right, bottom = (camera.width - 0.5) * z, (camera.height - 0.5) * z
            seen = (z > NEAR) & (uz > -0.5 * z) & (vz > -0.5 * z) & (uz < right) & (vz < bottom)
            at = np.flatnonzero(seen)
            if at.size == 0:
                continue
            z = z.ravel()[at]
            column = (uz.ravel()[at] / z + 0.5).astype(np.int32)
            row = (vz.ravel()[at] / z + 0.5).astype(np.int32)
            np.minimum(column, camera.width - 1, out=column)
            np.minimum(row, camera.height - 1, out=row)
            measured = image[row * camera.width + column]
            known = np.flatnonzero(measured > 0)
            at = at[known]
            slab, place = np.divmod(at, inner.size)
            voxel = (slab + begin[0] + x) * (shape[1] * shape[2]) + inner[place]
            yield Sight(voxel, z[known], measured[known])


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
