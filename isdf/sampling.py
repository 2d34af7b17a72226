"""Points along the rays of the selected frames (paper section 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .errors import ConfigError
from .frames import DepthFrame
from .numbers import require_finite

# Most samples a frame: a step on five such frames takes several gigabytes.
MAX_SAMPLES = 1 << 20


@dataclass(frozen=True)
class SamplingConfig:
    """How many points, and where. The defaults are the paper's.

    Args:
        rays_per_frame: random pixels of each selected frame that are trained on.
        stratified: N, samples spread over [min_depth, D + behind] a ray.
        near_surface: M, samples drawn from N(D, surface_sigma^2) a ray, kept within the stratified ones' range.
        min_depth: d_min [m].
        behind: delta, how far beyond the surface the stratified samples reach [m].
        surface_sigma: sigma_s of the samples near the surface [m].
        max_depth: pixels measured farther than this are ignored [m].
        extra_surface: further pixels of each frame that only add surface points to the batch distance's set P.
            0 in the paper; where the network is the cost, a denser P tightens the bound for little.
        normal_step: half width of the depth differences that give surface normals [pixels].
    """

    rays_per_frame: int = 200
    stratified: int = 20
    near_surface: int = 8
    min_depth: float = 0.07
    behind: float = 0.10
    surface_sigma: float = 0.10
    max_depth: float = 12.0
    extra_surface: int = 0
    normal_step: int = 1

    def __post_init__(self) -> None:
        require_finite(self)
        if self.rays_per_frame < 1 or self.stratified < 1 or self.near_surface < 0 or self.extra_surface < 0:
            raise ConfigError(
                "sampling needs rays_per_frame >= 1, stratified >= 1, near_surface >= 0 and extra_surface >= 0, got "
                f"{self.rays_per_frame}, {self.stratified}, {self.near_surface}, {self.extra_surface}"
            )
        samples = self.rays_per_frame * (self.stratified + self.near_surface + 1) + self.extra_surface
        if samples > MAX_SAMPLES:
            raise ConfigError(
                f"{samples} samples a frame do not fit a step, at most {MAX_SAMPLES} do; draw fewer rays"
            )
        if not 0 <= self.min_depth < self.max_depth:
            raise ConfigError(
                f"sampling needs 0 <= min_depth < max_depth, got {self.min_depth} and {self.max_depth} m"
            )
        if self.normal_step < 1:
            raise ConfigError(f"normal_step must be at least 1 pixel, got {self.normal_step}")


@dataclass(frozen=True)
class RayBatch:
    """r rays with k samples each, in the world frame; lengths are metres along the ray, not z-depths.

    Sample 0 of every ray is the measured surface. `frame` tells which of the selected frames a ray belongs to.
    """

    points: Float[Tensor, "r k 3"]
    along: Float[Tensor, "r k"]
    surface: Float[Tensor, "r 3"]
    surface_along: Float[Tensor, "r"]
    direction: Float[Tensor, "r 3"]
    normal: Float[Tensor, "r 3"]
    frame: Int[Tensor, "r"]
    extra_surface: Float[Tensor, "e 3"]

    @property
    def behind(self) -> Float[Tensor, "r k"]:
        """Signed distance along the ray from the sample to the surface, D - d [m]: negative behind it."""
        return self.surface_along[:, None] - self.along


def sample_rays(frames: Sequence[DepthFrame], config: SamplingConfig, generator: torch.Generator) -> RayBatch:
    """Draw random valid pixels of each frame, and points along their rays.

    Frames with fewer valid pixels than asked give what they have, with repetition.
    """
    rays, extras = [], []
    for index, frame in enumerate(frames):
        pixels = draw_pixels(frame.depth, config.rays_per_frame + config.extra_surface, config, generator)
        extras.append(_surface_points(frame, pixels[config.rays_per_frame :]))
        rays.append(_rays_of(frame, pixels[: config.rays_per_frame], config.normal_step, index))
    depth, direction, normal, position, owner = (torch.cat(parts) for parts in zip(*rays, strict=True))
    z = depths_along(depth, config, generator)
    # `direction` has z = 1 in the camera frame, so z-depth times it is the point and its norm turns depth to length.
    stretch = direction.norm(dim=-1)
    points = position[:, None] + z[..., None] * direction[:, None]
    return RayBatch(
        points=points,
        along=z * stretch[:, None],
        surface=points[:, 0],
        surface_along=depth * stretch,
        direction=direction / stretch[:, None],
        normal=normal,
        frame=owner,
        extra_surface=torch.cat(extras),
    )


def draw_pixels(
    depth: Float[Tensor, "h w"], count: int, config: SamplingConfig, generator: torch.Generator
) -> Int[Tensor, "n 2"]:
    """`count` random pixels (u, v) with a usable depth; none when the image has none."""
    flat_depth = depth.reshape(-1)
    # Rejection needs no pass over the image; most images are mostly valid.
    flat = torch.randint(len(flat_depth), (4 * count,), generator=generator).to(depth.device)
    flat = flat[_usable(flat_depth[flat], config)][:count]
    if len(flat) < count:
        valid = torch.nonzero(_usable(flat_depth, config))[:, 0]
        if len(valid) == 0:
            return torch.zeros(0, 2, dtype=torch.long, device=depth.device)
        flat = valid[torch.randint(len(valid), (count,), generator=generator).to(depth.device)]
    return torch.stack([flat % depth.shape[1], flat // depth.shape[1]], dim=-1)


def _usable(depth: Tensor, config: SamplingConfig) -> Tensor:
    return (depth > 0) & (depth <= config.max_depth)


def normals_at(frame: DepthFrame, pixels: Int[Tensor, "n 2"], step: int) -> Float[Tensor, "n 3"]:
    """Unit surface normals in the world frame, towards the camera, from the gradient of the depth image.

    NaN where a neighbour is invalid, outside the image, or across a depth edge (more than 10 % of the depth).
    """
    depth, camera = frame.depth, frame.camera
    u, v = pixels[:, 0], pixels[:, 1]

    def tangent(du: int, dv: int) -> tuple[Tensor, Tensor]:
        ends, usable = [], torch.ones_like(u, dtype=torch.bool)
        for sign in (1, -1):
            column, row = u + sign * du, v + sign * dv
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            column, row = column.clamp(0, camera.width - 1), row.clamp(0, camera.height - 1)
            z = depth[row, column]
            usable &= inside & (z > 0)
            ends.append(camera.rays(torch.stack([column, row], dim=-1)) * z[:, None])
        usable &= (ends[0][:, 2] - ends[1][:, 2]).abs() < 0.1 * depth[v, u]
        return ends[0] - ends[1], usable

    along_u, usable_u = tangent(step, 0)
    along_v, usable_v = tangent(0, step)
    normal = torch.linalg.cross(along_v, along_u)  # v x u points back at the camera (-z) for a frontal plane
    normal = torch.nn.functional.normalize(normal, dim=-1)
    normal = normal @ frame.T_world_camera[:3, :3].to(normal.dtype).T
    return torch.where((usable_u & usable_v)[:, None], normal, torch.full_like(normal, torch.nan))


def valid_normals(batch: RayBatch) -> Bool[Tensor, "r"]:
    """Rays whose surface normal could be measured."""
    return torch.isfinite(batch.normal).all(dim=-1)


def _rays_of(frame: DepthFrame, pixels: Tensor, normal_step: int, index: int) -> tuple[Tensor, ...]:
    T = frame.T_world_camera.float()
    depth = frame.depth[pixels[:, 1], pixels[:, 0]]
    direction = frame.camera.rays(pixels) @ T[:3, :3].T
    normal = normals_at(frame, pixels, normal_step)
    owner = torch.full((len(pixels),), index, dtype=torch.long, device=depth.device)
    return depth, direction, normal, T[:3, 3].expand_as(direction), owner


def _surface_points(frame: DepthFrame, pixels: Tensor) -> Tensor:
    T = frame.T_world_camera.float()
    depth = frame.depth[pixels[:, 1], pixels[:, 0]]
    return (frame.camera.rays(pixels) * depth[:, None]) @ T[:3, :3].T + T[:3, 3]


def depths_along(
    depth: Float[Tensor, "r"], config: SamplingConfig, generator: torch.Generator
) -> Float[Tensor, "r k"]:
    """z-depths [m] of k = 1 + M + N samples: the surface, Gaussian ones around it, stratified ones before it."""
    rays = len(depth)
    edges = torch.linspace(0, 1, config.stratified + 1)[:-1]
    jitter = torch.rand(rays, config.stratified, generator=generator) / config.stratified
    share = (edges + jitter).to(depth.device)
    far = depth[:, None] + config.behind
    # A surface nearer than d_min still gets samples: the range then starts at half its depth.
    near = torch.minimum(torch.full_like(far, config.min_depth), depth[:, None] / 2)
    stratified = near + share * (far - near)
    noise = torch.randn(rays, config.near_surface, generator=generator).to(depth.device)
    # Kept within the range, as the original does: what is farther behind a surface may well be free again.
    gaussian = (depth[:, None] + noise * config.surface_sigma).clamp(near, far)
    return torch.cat([depth[:, None], gaussian, stratified], dim=1)
