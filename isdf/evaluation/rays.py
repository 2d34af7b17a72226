"""Judging a map of the real world, whose distances nobody knows, by depth images it was not given."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..datasets import DepthSequence
from ..errors import EvaluationError
from .points import readable_frames

# Along a ray the field is looked at in steps of this much z-depth [m], from here on to here behind the surface.
STEP, NEAREST, BEHIND = 0.02, 0.1, 1.0
# Depths this close count as right [m]; free space this far in front of a surface must be free.
TOLERANCE = 0.05


@dataclass(frozen=True)
class Rays:
    """Measured rays in the world.

    Args:
        origin: (n, 3) camera positions [m].
        direction: (n, 3) a z-depth of 1 m along each ray; not of unit length.
        depth: (n,) measured z-depths [m].
    """

    origin: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 3"]
    depth: Float[Tensor, "n"]

    def __len__(self) -> int:
        return len(self.depth)

    def at(self, z: Float[Tensor, "n k"]) -> Float[Tensor, "n k 3"]:
        """World points [m] at z-depths [m]."""
        return self.origin[:, None] + z[..., None] * self.direction[:, None]


@dataclass(frozen=True)
class RayScores:
    """How well a map predicts the depth of rays it has not seen.

    Args:
        rays: how many.
        median_error: of |first zero - measured depth| [m].
        mean_error: the same; a ray without a zero up to 1 m behind the surface counts as an error of 1 m.
        within: share of rays within 5 cm.
        missed: share of rays without a zero.
        blocked: share of the free space (samples more than 5 cm in front of the surface) said to be inside a solid.
        overestimated: share of those samples whose distance is more than 5 cm above that to the measured surface
            point, so that it is certainly too large.
    """

    rays: int
    median_error: float
    mean_error: float
    within: float
    missed: float
    blocked: float
    overestimated: float

    def as_json(self) -> dict[str, Any]:
        """Plain values, to be written to a file."""
        return dataclasses.asdict(self)


def draw_rays(sequence: DepthSequence, count: int, seed: int, max_depth: float = 4.0) -> Rays:
    """Random measured pixels of all frames of a sequence, evenly spread over them.

    Args:
        sequence: frames that were not mapped.
        count: about how many rays.
        seed: of the draw.
        max_depth: pixels measured farther than this are not drawn [m]: there depth cameras err by centimetres.

    Raises:
        EvaluationError: no frame has a pixel in that range.
    """
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for frame in readable_frames(sequence, range(len(sequence))):
        pixels = ((frame.depth > NEAREST) & (frame.depth <= max_depth)).nonzero()
        if len(pixels) == 0:
            continue
        v, u = pixels[torch.randint(len(pixels), (max(1, count // len(sequence)),), generator=generator)].T
        T = frame.T_world_camera.float()
        direction = frame.camera.rays(torch.stack([u, v], dim=1)) @ T[:3, :3].T
        parts.append((T[:3, 3].expand_as(direction), direction, frame.depth[v, u]))
    if not parts:
        raise EvaluationError(f"{sequence.folder}: no frame has a pixel between {NEAREST} and {max_depth} m")
    return Rays(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def first_zero(
    z: Float[Tensor, "n k"], distance: Float[Tensor, "n k"], limit: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
    """The z-depth [m] at which each ray first meets a solid, by linear interpolation, and whether it does.

    Args:
        z: growing z-depths of the samples [m].
        distance: of a map at the samples [m]; a ray that starts inside a solid meets it at once.
        limit: z-depths [m] beyond which a ray is not followed; that of the rays that meet nothing.
    """
    inside = (distance <= 0) & (z <= limit[:, None])
    found = inside.any(dim=1)
    after = inside.int().argmax(dim=1, keepdim=True)
    before = (after - 1).clamp(min=0)
    z0, z1 = z.gather(1, before)[:, 0], z.gather(1, after)[:, 0]
    d0, d1 = distance.gather(1, before)[:, 0], distance.gather(1, after)[:, 0]
    share = torch.where(d0 > d1, d0 / (d0 - d1).clamp(min=1e-9), torch.zeros_like(d0)).clamp(0, 1)
    return torch.where(found, z0 + share * (z1 - z0), limit), found


def evaluate_rays(field: Any, rays: Rays, block: int = 1000) -> RayScores:
    """Judge a distance field by measured rays.

    Args:
        field: any distance field.
        rays: of frames it was not made from.
        block: rays looked at together.

    Raises:
        EvaluationError: an answer is NaN or infinite.
    """
    z = torch.arange(NEAREST, float(rays.depth.max()) + BEHIND + STEP, STEP)
    errors, missed, counts = [], 0, torch.zeros(3, dtype=torch.float64)
    for part in torch.arange(len(rays)).split(block):
        chosen = Rays(rays.origin[part], rays.direction[part], rays.depth[part])
        samples = z.expand(len(part), -1)
        distance = field.distance(chosen.at(samples))
        if not bool(torch.isfinite(distance).all()):
            raise EvaluationError("the field's distance is NaN or infinite somewhere on the rays")
        hit, found = first_zero(samples, distance, chosen.depth + BEHIND)
        errors.append((hit - chosen.depth).abs())
        missed += int((~found).sum())
        counts += _free_space(chosen, samples, distance)
    error = torch.cat(errors)
    return RayScores(
        rays=len(rays),
        median_error=float(error.median()),
        mean_error=float(error.mean()),
        within=float((error <= TOLERANCE).float().mean()),
        missed=missed / len(rays),
        blocked=float(counts[1] / counts[0].clamp(min=1)),
        overestimated=float(counts[2] / counts[0].clamp(min=1)),
    )


def _free_space(rays: Rays, z: Tensor, distance: Tensor) -> Float[Tensor, "3"]:
    """How many samples are certainly free; said to be inside solids; and certainly over-estimated."""
    ahead = (rays.depth[:, None] - z) * rays.direction.norm(dim=1, keepdim=True)
    free = ahead > TOLERANCE
    wrong = [free, free & (distance < 0), free & (distance > ahead + TOLERANCE)]
    return torch.stack([w.sum() for w in wrong]).double()
