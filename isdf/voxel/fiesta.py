"""FIESTA: occupancy by ray casting and incremental Euclidean distances (Han et al., IROS 2019)."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..errors import CheckpointError, ConfigError
from ..frames import DepthFrame
from ..numbers import require_finite
from .mapper import VoxelMapper, check_period
from .nearest_obstacle import FAR, Changes, NearestObstacle, moved
from .ray_occupancy import RayOccupancy
from .raycast import Rays, rays_of
from .volume import GrowingVolume, usable_depth
from .voxel_field import VoxelField

UNMAPPED, FREE, OCCUPIED = 0, 1, 2
CHANNELS: dict[str, type[np.generic]] = {
    "log_odds": np.float32,
    "observed": np.uint8,
    "state": np.uint8,
    "nearest_occupied": np.int32,
    "nearest_free": np.int32,
}


@dataclass(frozen=True)
class FiestaConfig:
    """Probabilities of the original's release, except as said.

    Args:
        voxel: edge of a voxel [m]; as Voxblox in the iSDF paper, which found the two to perform alike.
        hit: probability of a voxel to be occupied given an image that hits it.
        miss: the same given an image that looks through it.
        least: bound of the probability from below.
        greatest: and from above: contrary images soon turn a voxel.
        occupied: voxels of a higher probability are obstacles.
        max_depth: pixels measured farther than this are ignored [m]. The original's 5 m would leave out what all the
            other methods map.
        rebuild_period: least frame time between two updates of the distances [s].
        max_voxels: a frame that needs a larger volume is refused.
    """

    voxel: float = 0.055
    hit: float = 0.7
    miss: float = 0.35
    least: float = 0.12
    greatest: float = 0.97
    occupied: float = 0.6
    max_depth: float = 12.0
    rebuild_period: float = 1.0
    max_voxels: int = 64_000_000

    def __post_init__(self) -> None:
        require_finite(self, ("rebuild_period",))
        for name in ("voxel", "max_depth", "max_voxels"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        order = (0.0, self.least, self.miss, 0.5, self.hit, self.greatest, 1.0)
        if not all(a < b for a, b in itertools.pairwise(order)):
            raise ConfigError(
                f"probabilities must be 0 < least < miss < 0.5 < hit < greatest < 1, got {order[1:-1]}"
            )
        if not self.least < self.occupied < self.greatest:
            raise ConfigError(f"occupied must lie between least and greatest, got {self.occupied}")
        check_period(self.rebuild_period)


class FiestaMapper(VoxelMapper):
    """Occupancy, and for each voxel the nearest occupied and the nearest free one; see `VoxelMapper`.

    The distance is signed as the original's is when asked for: distance to the occupied minus distance to the free
    voxels, each kept by an algorithm of its own. Unlike in the original, newly mapped voxels ask their neighbours at
    once for an obstacle. Space that no ray was followed through is unmapped: confidence 0, and the distance of the
    nearest mapped voxel.

    Args:
        config: see `FiestaConfig`.
    """

    FORMAT = "isdf-fiesta-map"
    config: FiestaConfig

    def __init__(self, config: FiestaConfig | None = None) -> None:
        config = config or FiestaConfig()
        super().__init__(config, GrowingVolume(config.voxel, CHANNELS, config.max_voxels))
        gains, limits = (config.hit, config.miss), (config.least, config.greatest)
        self._occupancy = RayOccupancy(self.volume, _log_odds(*gains), _log_odds(*limits))
        self._make_lists()
        _compile()

    @classmethod
    def config_type(cls) -> type:
        """`FiestaConfig`."""
        return FiestaConfig

    @property
    def nbytes(self) -> int:
        """Memory of the volume, of the lists and of the current field [bytes]."""
        return super().nbytes + sum(a.nbytes for o in (self._solid, self._open) for a in o.lists[1:])

    def field(self) -> VoxelField:
        """An immutable snapshot of the distance field, at most `rebuild_period` of frame time old.

        Raises:
            NotReadyError: no frame was integrated yet, or none showed a surface.
        """
        return super().field()

    def save(self, path: str | Path, note: Mapping[str, Any] | None = None) -> None:
        """Write the volume to one file, atomically, after a `refresh`; see `VoxelMapper.save`."""
        super().save(path, note)
        # The file has no lists: to go on just as a map that is loaded from it, this one makes them anew as well.
        self._make_lists()

    def _fuse(self, frame: DepthFrame) -> None:
        depth, volume = usable_depth(frame, self.config.max_depth), self.volume
        shape, corner = volume.shape, volume.corner
        volume.include_frame(frame, np.where(depth > 0, depth + volume.voxel, 0))
        if volume.shape != shape:
            for name in ("nearest_occupied", "nearest_free"):
                moved(volume.channels[name].reshape(-1), shape, volume.shape, corner - volume.corner)
            self._make_lists()
        self._occupancy.fuse(rays_of(frame, depth, volume))

    def _rebuild(self) -> VoxelField | None:
        channels, state = self.volume.channels, self.volume.channels["state"]
        (threshold,) = _log_odds(self.config.occupied)
        now = channels["observed"] * (FREE + (channels["log_odds"] > threshold)).astype(np.uint8)
        changed = np.flatnonzero(now != state)
        old, new = state.reshape(-1)[changed], now.reshape(-1)[changed]
        fresh, mapped = changed[old == UNMAPPED], now != UNMAPPED
        for nearest, kind in ((self._solid, OCCUPIED), (self._open, FREE)):
            nearest.update(Changes(changed[new == kind], changed[old == kind], fresh), now == kind, mapped)
        state[:] = now
        reached = mapped & (self._solid.square < FAR) & (self._open.square < FAR)
        if not reached.any():
            return None
        voxels = np.sqrt(self._solid.square, dtype=np.float32) - np.sqrt(self._open.square, dtype=np.float32)
        return VoxelField(
            torch.from_numpy(np.where(reached, voxels * np.float32(self.volume.voxel), np.float32(np.nan))),
            torch.from_numpy(reached),
            torch.from_numpy(self.volume.origin.astype(np.float32)),
            self.volume.voxel,
            self._bounds,
        )

    def _check_channels(self) -> None:
        super()._check_channels()
        channels = self.volume.channels
        for name in ("nearest_occupied", "nearest_free"):
            values = channels[name]
            if values.size and not 0 <= values.min() <= values.max() <= values.size:
                raise CheckpointError(
                    f"{name} must name voxels of the map, got {values.min()} to {values.max()}"
                )
        self._make_lists()

    def _make_lists(self) -> None:
        channels = self.volume.channels
        self._solid = NearestObstacle(channels["nearest_occupied"])
        self._open = NearestObstacle(channels["nearest_free"])


def _log_odds(*probabilities: float) -> tuple[Any, ...]:
    return tuple(math.log(p / (1 - p)) for p in probabilities)


@functools.cache
def _compile() -> None:
    """Compile what runs later, so that no frame waits for it."""
    volume = GrowingVolume(1.0, CHANNELS, 1 << 20)
    volume.include(np.zeros(3), np.ones(3))
    RayOccupancy(volume, (1.0, -1.0), (-2.0, 2.0)).fuse(Rays(np.zeros(3), np.full((1, 3), 2.0), np.ones(1)))
    nearest, yes, none = volume.channels["nearest_free"], np.ones(volume.shape, dtype=bool), np.arange(0)
    obstacles, some = NearestObstacle(nearest), np.arange(2)
    obstacles.update(Changes(some, none, some), yes, yes)
    obstacles.update(Changes(none, some, none), ~yes, yes)
    moved(nearest.reshape(-1), volume.shape, volume.shape, volume.corner)
