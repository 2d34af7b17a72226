"""The default map: what the views prove, and between their bounds what a network guesses."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..cost import CostField
from ..errors import ConfigError, FrameError, NotReadyError
from ..extent import grown, nothing_seen
from ..frames import DepthFrame
from .bricks import SIDE, BrickVolume, missing_bricks
from .completion import STRIDE, CompletionNet, features
from .evidence import gather, look_through
from .field import LatticeField
from .fusion import fuse
from .lattice import Lattice
from .nearest import nearest_points
from .refresh import cells_to_refine, coarse_values, fine_values
from .seeds import surface_seeds

logger = logging.getLogger(__name__)

RATIO = 4  # voxels between coarse nodes
HALF_RATIO = 2  # voxels between the nodes whose nearest seeds are found
# Box about the camera in which distances are guessed anew [m], along and across the vertical.
GUESS_ACROSS, GUESS_ALONG = 4.48, 2.56
# The map reaches this far beyond what was seen [m].
BEYOND = np.array([2.5, 2.5, 1.5])
# Seeds this far outside a window still count in it [m]; nodes this far outside what was viewed are written anew.
SEED_MARGIN, WRITE_MARGIN = 2.5, 0.8
WEIGHTS = Path(__file__).parent.parent / "data" / "completion.safetensors"


@dataclass(frozen=True)
class MapperConfig:
    """The default map's settings.

    Args:
        voxel: edge of a fine voxel [m]; coarse nodes lie four of them apart.
        truncation: least truncation of the fused distances [m].
        truncation_noise: truncation per squared depth [m / m^2]: it follows the noise of far depth.
        max_depth: pixels measured farther than this are ignored [m].
        max_weight: of a voxel, in measurements at 1 m.
        refresh_period: least frame time between two refreshes of the distances [s].
        guess_period: least frame time between two runs of the network [s].
        max_bricks: a frame that needs a larger table of bricks (of eight voxels a side) is refused.
    """

    voxel: float = 0.04
    truncation: float = 0.12
    truncation_noise: float = 0.012
    max_depth: float = 10.0
    max_weight: float = 20.0
    refresh_period: float = 0.35
    guess_period: float = 1.0
    max_bricks: int = 8_000_000

    def __post_init__(self) -> None:
        for name in ("voxel", "truncation", "max_depth", "max_weight", "max_bricks"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if not self.truncation > 2 * self.voxel:
            raise ConfigError(f"truncation must be more than two voxels, got {self.truncation} m and {self.voxel} m")
        if min(self.refresh_period, self.guess_period, self.truncation_noise) < 0:
            raise ConfigError("refresh_period, guess_period and truncation_noise must be zero or more")


class Mapper:
    """Maps posed depth images online."""

    def __init__(self, config: MapperConfig | None = None, device: str | torch.device = "cpu") -> None:
        self.config = config or MapperConfig()
        self.device = torch.device(device)
        self.bricks = BrickVolume(self.config.voxel, self.config.max_bricks)
        self.lattice = Lattice(RATIO * self.config.voxel)
        self.network = load_network().to(self.device)
        self.frames_seen = self.steps = 0
        self.times: dict[str, float] = {}
        self._bounds = nothing_seen()
        self._viewed: np.ndarray | None = None
        self._refreshed_at = self._guessed_at = -math.inf
        self._up = np.zeros(3)
        self._ready = False

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        if self.frames_seen == 0:
            raise NotReadyError("nothing was seen yet: call mapper.integrate(frame) first")
        return self._bounds.clone()

    def integrate(self, frame: Any) -> None:
        frame = DepthFrame.of(frame).to(torch.device("cpu"))
        depth = frame.depth.numpy()
        depth = np.where(depth <= self.config.max_depth, depth, np.float32(0))
        if not depth.any():
            raise FrameError("no pixel in reach")
        T = frame.T_world_camera.numpy()
        box = self._view_box(depth, frame, T)
        self.bricks.include(box[0], box[1])
        self._bounds = grown(self._bounds, frame, self.config.max_depth)
        seen = self._bounds.numpy().astype(float)
        self.lattice.include(np.minimum(seen[0] - BEYOND, box[0]), np.maximum(seen[1] + BEYOND, box[1]))
        self._fuse(depth, frame, T, box)
        self._up -= T[:3, 1]
        self.frames_seen += 1
        margin = np.array([[-WRITE_MARGIN], [WRITE_MARGIN]])
        viewed = box + margin
        self._viewed = viewed if self._viewed is None else np.stack([np.minimum(self._viewed[0], viewed[0]), np.maximum(self._viewed[1], viewed[1])])
        if not 0 < frame.time - self._refreshed_at < self.config.refresh_period or not self._ready:
            guess = not 0 < frame.time - self._guessed_at < self.config.guess_period
            if guess:
                self._guess(T[:3, 3])
                self._guessed_at = frame.time
            self.refresh()
            self._refreshed_at = frame.time

    def _view_box(self, depth: np.ndarray, frame: DepthFrame, T: np.ndarray) -> np.ndarray:
        camera = frame.camera
        v, u = np.nonzero(depth)
        z = depth[v, u] + np.maximum(self.config.truncation, self.config.truncation_noise * depth[v, u] ** 2) + 0.05
        p = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1) @ T[:3, :3].T + T[:3, 3]
        return np.stack([np.minimum(p.min(0), T[:3, 3]), np.maximum(p.max(0), T[:3, 3])])

    def _fuse(self, depth: np.ndarray, frame: DepthFrame, T: np.ndarray, box: np.ndarray) -> None:
        config, bricks, camera = self.config, self.bricks, frame.camera
        intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        stride = max(1, int(0.03 * camera.fx / 2))
        edge = SIDE * config.voxel
        found = missing_bricks(bricks.table, bricks.corner, edge, depth, stride, config.truncation_noise, config.truncation, intrinsics, T)
        bricks.add(found)
        inverse = np.linalg.inv(T)
        begin = np.clip(np.floor(box[0] / edge).astype(np.int64) - bricks.corner, 0, bricks.table.shape)
        end = np.clip(np.floor(box[1] / edge).astype(np.int64) + 1 - bricks.corner, 0, bricks.table.shape)
        fuse(bricks.table, bricks.corner, bricks._distance, bricks._weight, config.voxel, begin, end, depth,
             config.truncation_noise, config.truncation, config.max_weight, intrinsics, inverse)
        begin, end = self.lattice.window(*box)
        look_through(self.lattice.evidence, self.lattice.corner, self.lattice.spacing, begin, end, depth, intrinsics, inverse)

    def _seeds(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bricks, edge = self.bricks, SIDE * self.config.voxel
        begin = np.clip(np.floor((lower - SEED_MARGIN) / edge).astype(np.int64) - bricks.corner, 0, bricks.table.shape)
        end = np.clip(np.floor((upper + SEED_MARGIN) / edge).astype(np.int64) + 1 - bricks.corner, 0, bricks.table.shape)
        return surface_seeds(bricks.table, bricks.corner, bricks._distance, bricks._weight, self.config.voxel, begin, end)

    def _guess(self, eye: np.ndarray) -> None:
        lattice = self.lattice
        up = int(np.abs(self._up).argmax())
        reach = np.full(3, GUESS_ACROSS)
        reach[up] = GUESS_ALONG
        begin, end = lattice.window(eye - reach, eye + reach)
        end = begin + (end - begin) // STRIDE * STRIDE
        seeds, _ = self._seeds(eye - reach, eye + reach)
        if len(seeds) == 0:
            return
        part = tuple(slice(b, e) for b, e in zip(begin, end, strict=True))
        # The network knows the vertical as the last axis, upwards.
        order = [a for a in range(3) if a != up] + [up]
        flip = self._up[up] < 0
        evidence = lattice.evidence[part].transpose(order)
        corner, points = (lattice.corner + begin)[order], seeds[:, order].copy()
        if flip:
            evidence = evidence[:, :, ::-1]
            corner[2] = -(corner[2] + evidence.shape[2] - 1)
            points[:, 2] *= -1
        x = features(gather(points, np.ascontiguousarray(evidence), corner, lattice.spacing))
        with torch.no_grad():
            share, width = (t[0].cpu().numpy() for t in self.network(x[None].to(self.device)))
        back = np.argsort(order)
        for name, values in (("share", share), ("width", width)):
            values = values[:, :, ::-1] if flip else values
            getattr(lattice, name)[part] = values.transpose(back)
        lattice.guessed[part] = True
        low, high = lattice.spacing * (lattice.corner + begin), lattice.spacing * (lattice.corner + end - 1)
        self._viewed = np.stack([np.minimum(self._viewed[0], low), np.maximum(self._viewed[1], high)])

    def refresh(self) -> None:
        if self._viewed is None:
            return
        lattice, bricks, voxel = self.lattice, self.bricks, self.config.voxel
        begin, end = lattice.window(self._viewed[0], self._viewed[1])
        seeds, normals = self._seeds(lattice.spacing * (lattice.corner + begin), lattice.spacing * (lattice.corner + end))
        if len(seeds) == 0:
            return
        self._viewed = None
        step = HALF_RATIO
        size = (end - begin - 1) * (RATIO // step) + 1
        places = (seeds / np.float32(step * voxel) - (lattice.corner + begin) * (RATIO // step)).astype(np.float32)
        nearest, _ = nearest_points(places, tuple(int(s) for s in size), 1)
        part = tuple(slice(b, e) for b, e in zip(begin, end, strict=True))
        lower = gather(seeds, np.ascontiguousarray(lattice.evidence[part]), lattice.corner + begin, lattice.spacing).lower
        state, gap = np.zeros(lower.shape, np.int8), np.zeros(lower.shape, np.float32)
        offset = np.zeros(3, np.int64)
        patch = 0.5 * voxel
        source = (bricks.table, bricks.corner, bricks._distance, bricks._weight, voxel, lattice.evidence)
        coarse_values(begin, end, offset, step, nearest, seeds, normals, patch, lower, lattice.corner, lattice.spacing,
                      *source, lattice.share.astype(np.float32), lattice.width.astype(np.float32), lattice.value, lattice.confidence, state, gap)
        refine, stale = np.zeros(lower.shape, np.bool_), np.zeros(lower.shape, np.bool_)
        cells_to_refine(begin, end, offset, step, nearest, seeds, normals, patch, lattice.corner, lattice.spacing,
                        *source, lattice.value, state, gap, lattice.block, lattice.corrections, refine, stale)
        block = lattice.block[part]
        gone = ~refine & (block >= 0)
        gone[-1], gone[:, -1], gone[:, :, -1] = False, False, False
        lattice.spare += block[gone].tolist()
        block[gone] = -1
        fresh = refine & (block < 0)
        block[fresh] = lattice.take_blocks(int(fresh.sum()))
        cells = np.argwhere((block >= 0) & (fresh | stale))
        self.written = (len(cells), int(refine.sum()))
        fine_values(cells, block[tuple(cells.T)], begin, offset, step, nearest, seeds, normals, patch, lattice.corner, lattice.spacing,
                    *source, lattice.value, state, gap, lattice.corrections)
        self._ready = True
        self.steps += 1

    def step(self) -> float:
        return 0.0

    def field(self) -> LatticeField:
        if not self._ready:
            raise NotReadyError("no surface was seen yet: call mapper.integrate(frame) first")
        lattice = self.lattice
        return LatticeField(lattice.value.copy(), lattice.confidence.copy(), lattice.block.copy(), lattice.corrections[: lattice.used].copy(),
                            lattice.corner.copy(), lattice.spacing, self._bounds)

    def cost_field(self, eps: float) -> CostField:
        return CostField(self.field(), eps)


def load_network() -> CompletionNet:
    from safetensors.torch import load_file

    net = CompletionNet()
    import os
    path = os.environ.get("NET", str(WEIGHTS))
    net.load_state_dict({k: v.float() for k, v in load_file(path).items()})
    return net.eval()
