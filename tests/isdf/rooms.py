"""Analytic rooms and a depth camera that sphere-traces them: known geometry to test the mapper against."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from isdf import DepthFrame, Mapper, PinholeCamera

SDF = Callable[[Tensor], Tensor]


def box(centre: tuple[float, float, float], size: tuple[float, float, float]) -> SDF:
    """A solid box."""

    def distance(p: Tensor) -> Tensor:
        q = (p - torch.tensor(centre).to(p)).abs() - 0.5 * torch.tensor(size).to(p)
        return q.clamp(min=0).norm(dim=-1) + q.amax(dim=-1).clamp(max=0)

    return distance


def ball(centre: tuple[float, float, float], radius: float) -> SDF:
    """A solid ball."""
    return lambda p: (p - torch.tensor(centre).to(p)).norm(dim=-1) - radius


def inside_of(sdf: SDF) -> SDF:
    """The hollow of a solid: a room instead of a block."""
    return lambda p: -sdf(p)


def union(*sdfs: SDF) -> SDF:
    """Composition by min."""
    return lambda p: torch.stack([s(p) for s in sdfs]).amin(dim=0)


def furnished_room() -> SDF:
    """5 x 4 x 2.5 m with a table, a cupboard and a ball on the floor; exact outside the solids."""
    legs = [box((x, y, 0.35), (0.06, 0.06, 0.7)) for x in (0.6, 1.6) for y in (0.2, 0.8)]
    return union(
        inside_of(box((0, 0, 1.25), (5, 4, 2.5))),
        box((1.1, 0.5, 0.72), (1.2, 0.8, 0.05)),
        *legs,
        box((-2.0, 1.2, 0.9), (0.6, 1.2, 1.8)),
        ball((-0.6, -1.0, 0.35), 0.35),
    )


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """T_world_camera with OpenCV axes, z up in the world."""
    position, forward = np.array(eye, float), np.array(target, float) - np.array(eye, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = position
    return T


def render(sdf: SDF, T: np.ndarray, camera: PinholeCamera, time: float = 0.0) -> DepthFrame:
    """An exact z-depth image by sphere tracing."""
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    rays = camera.rays(torch.stack([u, v], dim=-1)).double()
    pose = torch.as_tensor(T, dtype=torch.float64)
    directions = (rays @ pose[:3, :3].T).view(-1, 3)
    z, active = torch.zeros(len(directions), dtype=torch.float64), torch.arange(len(directions))
    for _ in range(300):
        gap = sdf(pose[:3, 3] + z[active, None] * directions[active])
        z[active] += gap / directions[active].norm(dim=-1)
        active = active[(gap > 1e-5) & (z[active] < 30.0)]
        if len(active) == 0:
            break
    return DepthFrame(z.float().view(rays.shape[:2]), T, camera, time)


@functools.lru_cache(maxsize=4)
def furnished_orbit(frames: int, width: int = 80) -> tuple[DepthFrame, ...]:
    """`orbit` in the furnished room with a 60 degree camera, rendered once for all tests."""
    camera = PinholeCamera.from_fov(width, width * 3 // 4, math.radians(60))
    return tuple(orbit(furnished_room(), frames, camera))


def orbit(sdf: SDF, frames: int, camera: PinholeCamera, fps: float = 10.0) -> list[DepthFrame]:
    """A camera that turns once about itself near the middle of the room, 1.2 m up and looking slightly down."""
    out = []
    for i in range(frames):
        angle = 2 * math.pi * i / frames
        eye = (0.3 * math.cos(angle), -0.3 + 0.3 * math.sin(angle), 1.2)
        target = (eye[0] + math.cos(angle), eye[1] + math.sin(angle), 0.85)
        out.append(render(sdf, look_at(eye, target), camera, i / fps))
    return out


def mapped(frames: Sequence[DepthFrame]) -> Mapper:
    """The default map of some frames."""
    mapper = Mapper()
    for frame in frames:
        mapper.integrate(frame)
    mapper.refresh()
    return mapper
