"""Small robots made of spheres for tests."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Disc:
    """A disc in the plane: base_x, base_y; one sphere."""

    num_dofs = 2
    joint_names = ("base_x", "base_y")

    def __init__(self, radius: float = 0.1, height: float = 0.3, limit: float = math.inf) -> None:
        self.radius, self.height = radius, height
        self.joint_limits = torch.tensor([[-limit, limit]] * 2)
        self.velocity_limits = torch.tensor([1.0, 1.0])

    def spheres(self, q: Tensor) -> tuple[Tensor, Tensor]:
        centres = torch.cat([q, torch.full_like(q[..., :1], self.height)], dim=-1)
        return centres.unsqueeze(-2), torch.tensor([self.radius]).to(q)


class Base:
    """A mobile base: x, y, yaw; a row of spheres, the lower ones on the floor."""

    num_dofs = 3
    joint_names = ("base_x", "base_y", "base_yaw")

    def __init__(self, offsets: Tensor | None = None, radius: float = 0.1) -> None:
        if offsets is None:
            offsets = torch.tensor([[x, 0.0, z] for z in (0.1, 0.4) for x in (-0.2, 0.0, 0.2)])
        self.offsets, self.radius = offsets, radius
        self.joint_limits = torch.tensor([[-math.inf, math.inf]] * 3)
        self.velocity_limits = torch.tensor([0.5, 0.5, 1.0])
        self.floor_spheres = offsets[:, 2] < 0.2
        self.sphere_links = tuple("base" if low else "torso" for low in self.floor_spheres.tolist())

    def spheres(self, q: Tensor) -> tuple[Tensor, Tensor]:
        offsets = self.offsets.to(q)
        cos, sin = q[..., 2:3].cos(), q[..., 2:3].sin()
        x = q[..., 0:1] + cos * offsets[:, 0] - sin * offsets[:, 1]
        y = q[..., 1:2] + sin * offsets[:, 0] + cos * offsets[:, 1]
        z = offsets[:, 2].expand_as(x)
        return torch.stack([x, y, z], dim=-1), torch.full((len(offsets),), self.radius).to(q)


class PlanarArm:
    """Revolute links in the plane z = 0.5 with spheres along them; non-neighbouring links must not touch."""

    def __init__(
        self, lengths: tuple[float, ...] = (0.5, 0.5), per_link: int = 5, radius: float = 0.05
    ) -> None:
        self.lengths, self.per_link, self.radius = lengths, per_link, radius
        self.num_dofs = len(lengths)
        self.joint_names = tuple(f"joint{i + 1}" for i in range(self.num_dofs))
        self.joint_limits = torch.tensor([[-3.0, 3.0]] * self.num_dofs)
        self.velocity_limits = torch.full((self.num_dofs,), 2.0)
        link = torch.arange(self.num_dofs).repeat_interleave(per_link)
        self.sphere_links = tuple(f"link{int(i) + 1}" for i in link)
        first, second = torch.triu_indices(len(link), len(link), 1)
        apart = link[second] - link[first] > 1
        self.self_collision_pairs = torch.stack([first[apart], second[apart]], dim=1)

    def spheres(self, q: Tensor) -> tuple[Tensor, Tensor]:
        angle = q.cumsum(-1)
        direction = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
        steps = direction * torch.tensor(self.lengths).to(q)[:, None]
        ends = steps.cumsum(-2)
        fractions = (torch.arange(self.per_link).to(q) + 0.5) / self.per_link
        along = (ends - steps).unsqueeze(-2) + fractions[:, None] * steps.unsqueeze(-2)
        centres = along.flatten(-3, -2) + torch.tensor([0.0, 0.0, 0.5]).to(q)
        return centres, torch.full((centres.shape[-2],), self.radius).to(q)
