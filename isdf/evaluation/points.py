"""Where maps are judged: the region a camera has seen, and the free space it has not."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ..datasets import DepthSequence
from ..errors import DatasetError, EvaluationError, FrameError
from ..frames import DepthFrame

# One frame in so many is looked at, as in the paper's evaluation.
FRAME_STRIDE = 5
# Draws of unseen points that may miss the free space before fewer points are returned than asked for.
ROUNDS = 50


class VisibleRegion:
    """Random points of what a camera has seen, drawn as in the paper's evaluation (section 5.3).

    On random pixels of every `stride`-th frame seen so far, one z-depth uniform in [`near`, D + `behind`], with D the
    noise-free depth of the pixel: mostly free space, and a little of what lies behind surfaces.

    Args:
        sequence: noise-free depth images.
        stride: of the frames.
        near: least z-depth [m].
        behind: how far behind the surface [m].
        max_depth: pixels beyond this z-depth are not drawn [m].
    """

    def __init__(
        self,
        sequence: DepthSequence,
        stride: int = FRAME_STRIDE,
        near: float = 0.1,
        behind: float = 0.1,
        max_depth: float = 12.0,
    ) -> None:
        self.sequence, self.stride = sequence, stride
        self.near, self.behind, self.max_depth = near, behind, max_depth

    def points(self, last: int, count: int, seed: int) -> Float[Tensor, "n 3"]:
        """World points [m] of frames 0 to `last`; `count` of them, fewer only if frames cannot be read.

        Raises:
            EvaluationError: no frame so far shows anything.
        """
        generator = torch.Generator().manual_seed(seed)
        frames = list(readable_frames(self.sequence, range(0, last + 1, self.stride)))
        frames = [f for f in frames if bool(self._usable(f).any())]
        if not frames:
            raise EvaluationError(
                f"{self.sequence.folder}: none of frames 0 to {last} has a pixel within {self.max_depth} m"
            )
        shares = np.diff(np.linspace(0, count, len(frames) + 1).astype(int))
        drawn = [self._draw(f, int(n), generator) for f, n in zip(frames, shares, strict=True)]
        return torch.cat(drawn)

    def _usable(self, frame: DepthFrame) -> Bool[Tensor, "h w"]:
        return (frame.depth > self.near) & (frame.depth <= self.max_depth)

    def _draw(self, frame: DepthFrame, count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
        pixels = self._usable(frame).nonzero()
        v, u = pixels[torch.randint(len(pixels), (count,), generator=generator)].unbind(dim=1)
        reach = frame.depth[v, u] + self.behind - self.near
        z = self.near + torch.rand(count, generator=generator) * reach
        T = frame.T_world_camera.float()
        return (frame.camera.rays(torch.stack([u, v], dim=1)) * z[:, None]) @ T[:3, :3].T + T[:3, 3]


def unseen_points(
    sequence: DepthSequence,
    truth: Any,
    room: Float[Tensor, "2 3"],
    count: int,
    seed: int,
    margin: float = 0.25,
    voxel: float = 0.05,
) -> Float[Tensor, "n 3"]:
    """Random points of the free room volume that are farther than `margin` from anything seen: where maps must guess.

    A point counts when it is inside the room's box, outside all solids (true distance above 0), and farther than
    `margin` from every point of every observed voxel; see `observed_voxels`.

    Args:
        sequence: noise-free depth images.
        truth: exact distance field.
        room: lower and upper corner of the room [m].
        count: how many points.
        seed: of the draw.
        margin: distance to what was seen [m].
        voxel: size of the voxels in which it is recorded what was seen [m].

    Returns:
        World points [m]; fewer than `count`, or none, where there is hardly such space.
    """
    observed = observed_voxels(sequence, room, voxel)
    away = distance_transform_edt(~observed.numpy()) * voxel if bool(observed.any()) else np.inf
    # Two half diagonals: from the point to its voxel's centre, and from the observed centre to its voxel's corner.
    cells = np.argwhere(np.broadcast_to(away, observed.shape) > margin + math.sqrt(3) * voxel)
    found: list[Tensor] = []
    generator = torch.Generator().manual_seed(seed)
    for _ in range(ROUNDS if len(cells) else 0):
        chosen = torch.from_numpy(cells)[torch.randint(len(cells), (count,), generator=generator)]
        points = room[0] + voxel * (chosen + torch.rand(count, 3, generator=generator))
        free = (points <= room[1]).all(dim=1) & (truth.distance(points) > 0)
        found.append(points[free])
        if sum(len(p) for p in found) >= count:
            break
    return torch.cat(found or [torch.zeros(0, 3)])[:count]


def observed_voxels(
    sequence: DepthSequence, room: Float[Tensor, "2 3"], voxel: float, stride: int = FRAME_STRIDE
) -> Bool[Tensor, "nx ny nz"]:
    """Voxels of a box whose centre some frame has seen: in front of the measured depth or at most half a voxel behind.

    Args:
        sequence: depth images; every `stride`-th and the last are looked at.
        room: lower and upper corner of the box [m].
        voxel: edge of a voxel [m].
        stride: of the frames.
    """
    counts = torch.ceil((room[1] - room[0]) / voxel).long().tolist()
    axes = [room[0, i] + voxel * (torch.arange(n) + 0.5) for i, n in enumerate(counts)]
    centres = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).view(-1, 3)
    hidden = torch.arange(len(centres))
    for frame in readable_frames(sequence, sorted({*range(0, len(sequence), stride), len(sequence) - 1})):
        hidden = hidden[~_sees(frame, centres[hidden], 0.5 * voxel)]
    observed = torch.ones(len(centres), dtype=torch.bool)
    observed[hidden] = False
    return observed.view(counts)


def _sees(frame: DepthFrame, points: Float[Tensor, "n 3"], tolerance: float) -> Bool[Tensor, "n"]:
    """Which points project into a frame no deeper than `tolerance` [m] behind its measurement there."""
    T, camera = frame.T_world_camera.float(), frame.camera
    x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).unbind(dim=1)
    ahead = z > 1e-3
    z = torch.where(ahead, z, torch.ones_like(z))
    u, v = (camera.fx * x / z + camera.cx).round().long(), (camera.fy * y / z + camera.cy).round().long()
    inside = ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    depth = frame.depth[torch.where(inside, v, 0), torch.where(inside, u, 0)]
    return inside & (depth > 0) & (z <= depth + tolerance)


def readable_frames(sequence: DepthSequence, indices: Iterable[int]) -> Iterator[DepthFrame]:
    """Frames of these numbers, without those that cannot be read or used."""
    for index in indices:
        try:
            yield sequence[index]
        except (FrameError, DatasetError):
            continue
