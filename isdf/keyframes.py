"""The sparse set of frames that are replayed against forgetting (paper section 4.2, after iMAP)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import ConfigError
from .frames import DepthFrame
from .network import SDFNetwork
from .numbers import require_finite
from .sampling import SamplingConfig, depths_along, draw_pixels


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame is kept, and how many are replayed. The defaults are those of the paper and its code.

    Args:
        replayed: keyframes drawn at each step, besides the newest frame and the last keyframe.
        test_rays: random rays of the information-gain test.
        test_samples: stratified samples along each of those rays, besides those at and near the surface.
        test_behind: how far beyond the measured surface they reach [m].
        relative_error: a ray counts as explained when its rendered depth is within this share of the measured.
        explained_below: the frame becomes a keyframe when a smaller share of rays than this is explained.
        force_after: a keyframe is forced this long after the last one [s of frame time].
    """

    replayed: int = 3
    test_rays: int = 400
    test_samples: int = 19
    test_behind: float = 0.8
    relative_error: float = 0.10
    explained_below: float = 0.65
    force_after: float = 5.0

    def __post_init__(self) -> None:
        require_finite(self, ("force_after",))
        if self.replayed < 0 or self.test_rays < 1 or self.test_samples < 2 or self.test_behind < 0:
            raise ConfigError(
                "keyframes need replayed >= 0, test_rays >= 1, test_samples >= 2 and test_behind >= 0, got "
                f"{self.replayed}, {self.test_rays}, {self.test_samples} and {self.test_behind} m"
            )


@dataclass
class KeyframeSet:
    """Keyframes with the running loss of each, in the order they were added."""

    frames: list[DepthFrame] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.frames)

    def add(self, frame: DepthFrame) -> None:
        """Append a keyframe; until it is trained on it counts as lossy as the worst one."""
        self.frames.append(frame)
        self.losses.append(max(self.losses, default=1.0))

    def draw(self, count: int, candidates: int, generator: torch.Generator) -> list[int]:
        """Indices of `count` of the first `candidates` keyframes, without replacement, with odds by running loss."""
        count = min(count, candidates)
        if count <= 0:
            return []
        odds = torch.tensor(self.losses[:candidates]).clamp(min=1e-6)
        return torch.multinomial(odds, count, replacement=False, generator=generator).tolist()

    def record(self, index: int, loss: float) -> None:
        """Fold the newest mean loss of one keyframe into its running loss."""
        self.losses[index] += 0.5 * (loss - self.losses[index])


def render_depth(
    network: Callable[[Tensor], Tensor],
    z: Float[Tensor, "r k"],
    direction: Float[Tensor, "r 3"],
    position: Float[Tensor, "3"],
) -> Float[Tensor, "r"]:
    """z-depth [m] of the network's first zero crossing along each ray, inf where it has none.

    Args:
        network: distances [m] of (n, 3) points.
        z: z-depths [m] of the samples of each ray, increasing.
        direction: of the rays in the world, with z = 1 in the camera frame.
        position: of the camera [m].
    """
    points = position + z[..., None] * direction[:, None]
    with torch.no_grad():
        distance = network(points.reshape(-1, 3)).view(z.shape)
    crosses = (distance[:, :-1] > 0) & (distance[:, 1:] <= 0)
    first = crosses.float().argmax(dim=1, keepdim=True)
    before, after = distance.gather(1, first), distance.gather(1, first + 1)
    z0, z1 = z.gather(1, first), z.gather(1, first + 1)
    crossing = z0 + (z1 - z0) * before / (before - after).clamp(min=1e-9)
    return torch.where(crosses.any(dim=1), crossing[:, 0], torch.full_like(z[:, 0], torch.inf))


def explained_share(
    network: SDFNetwork,
    frame: DepthFrame,
    config: KeyframeConfig,
    sampling: SamplingConfig,
    generator: torch.Generator,
) -> float:
    """Share of random rays of the frame whose depth the (frozen) network already renders correctly."""
    pixels = draw_pixels(frame.depth, config.test_rays, sampling, generator)
    if len(pixels) == 0:
        return 1.0  # nothing measurable, nothing to gain
    T = frame.T_world_camera.to(frame.depth.dtype)
    depth = frame.depth[pixels[:, 1], pixels[:, 0]]
    direction = frame.camera.rays(pixels) @ T[:3, :3].T
    along = replace(sampling, stratified=config.test_samples, behind=config.test_behind)
    z = depths_along(depth, along, generator).sort(dim=1).values
    rendered = render_depth(network, z, direction, T[:3, 3])
    return float(((rendered - depth).abs() < config.relative_error * depth).float().mean())
