"""The maps a closed loop can drive by: those of every method, and the ground truth to compare them with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import isdf
from isdf.methods import Config, OnlineMapper, new_mapper
from isdf.voxel import ExactConfig, FiestaConfig, KinectFusionConfig, VoxbloxConfig
from robots.simulation import SceneField, World

Method = Literal["default", "isdf", "voxblox", "fiesta", "kinectfusion", "exact", "truth"]


class TrueMap:
    """Knows the world as it is, whatever it is shown; for comparison only.

    Args:
        world: made of solids; a scene of meshes has no ground-truth field.
    """

    def __init__(self, world: World) -> None:
        if not world.solids:
            raise SystemExit(f"{world.scene.name} has no ground-truth field: choose another map than 'truth'")
        self.world = world
        self.frames_seen = self.steps = 0

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Lower and upper corner of the room [m]."""
        width, depth, height = self.world.scene.size or (20.0, 20.0, 3.0)
        return torch.tensor([[-width / 2, -depth / 2, 0.0], [width / 2, depth / 2, height]])

    def integrate(self, frame: Any) -> None:
        """Count the frame."""
        self.frames_seen += 1

    def step(self) -> float:
        """Nothing to learn: a loss of 0."""
        return 0.0

    def run_for(self, cpu_seconds: float) -> int:
        """Nothing to learn: no steps."""
        return 0

    def field(self) -> SceneField:
        """The exact field of the solids where they are now."""
        return self.world.field()


def new_map(method: Method, seed: int, world: World) -> OnlineMapper | TrueMap:
    """An empty map of a method. The loop decides when a network trains, so taking in a frame does not."""
    if method == "truth":
        return TrueMap(world)
    untimed = {"first_frame_steps": 0, "steps_per_frame": 0, "keyframe_steps": 0}
    configs: dict[str, Config] = {
        "default": isdf.MapperConfig(visitors=2.0),
        "isdf": replace(isdf.IsdfConfig(seed=seed), **untimed),
        "voxblox": VoxbloxConfig(),
        "fiesta": FiestaConfig(),
        "kinectfusion": KinectFusionConfig(),
        "exact": ExactConfig(),
    }
    return new_mapper(configs[method])


def mean_error(field: Any, truth: SceneField, bounds: Float[Tensor, "2 3"]) -> dict[str, float]:
    """Mean and 95th percentile of |mapped - true| distance [m] in the free space a robot moves in."""
    low, high = bounds
    generator = torch.Generator().manual_seed(0)
    points = low + (high - low) * torch.rand(20_000, 3, generator=generator)
    exact = truth.distance(points)
    free = (exact > 0) & (points[:, 2] > 0) & (points[:, 2] < 1.5)
    error = (field.distance(points[free]) - exact[free]).abs().numpy()
    return {"mean": float(np.mean(error)), "p95": float(np.quantile(error, 0.95))}
