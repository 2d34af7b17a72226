"""Settings of the default map."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import ConfigError
from ..numbers import require_finite

# Four times the default limit; a brick takes six kilobytes, though most places never get one.
MOST_BRICKS = 1 << 27
# A depth camera that errs by a tenth needs another calibration than this one.
MOST_DISTORTION = 0.1


@dataclass(frozen=True)
class MapperConfig:
    """Settings of the default map.

    Args:
        voxel: edge of a voxel of the fused surfaces [m]; the nodes of the distances lie two of them apart where they
            are finest and eight elsewhere, and the network knows no other.
        truncation: least truncation of the fused distances [m].
        truncation_noise: truncation per squared depth [m / m^2]: it follows the noise of far depth.
        max_depth: pixels measured farther than this are ignored [m].
        max_weight: of a voxel, in measurements at 1 m: enough to average the noise.
        fuse_period: least frame time between two images that are fused [s]: those between show hardly more.
        refresh_period: least frame time between two refreshes of the distances [s].
        guess_period: least frame time between two runs of the network [s]; it waits for the end of a refresh.
        distortion: how large the camera's own low-frequency depth error is expected to be, as a share of the depth
            (standard deviation); the map learns it from the images and frees them of it. 0: depth is taken as it is.
        visitors: what came into free space, was not seen to stay and has been out of view for this long [s], or for as
            long as it had stood there, is taken back out of the map, for somebody who walks by does not stand where the
            camera saw him last; None: never.
        max_bricks: a frame that needs a larger table of bricks (of eight voxels a side) is refused.
    """

    voxel: float = 0.02
    truncation: float = 0.06
    truncation_noise: float = 0.012
    max_depth: float = 10.0
    max_weight: float = 20.0
    fuse_period: float = 0.05
    refresh_period: float = 0.25
    guess_period: float = 1.0
    distortion: float = 0.01
    visitors: float | None = None
    max_bricks: int = 32_000_000

    def __post_init__(self) -> None:
        require_finite(
            self,
            (
                "guess_period",
                "refresh_period",
            ),
        )
        if self.visitors is not None and not self.visitors > 0:
            raise ConfigError(
                f"visitors must be positive, or None for a map that forgets nothing, got {self.visitors} s"
            )
        for name in ("voxel", "truncation", "max_depth", "max_weight", "max_bricks"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if self.max_bricks > MOST_BRICKS:
            raise ConfigError(
                f"max_bricks must be at most {MOST_BRICKS}, got {self.max_bricks}: memory ends before"
            )
        if not self.truncation > 2 * self.voxel:
            raise ConfigError(
                f"truncation must be more than two voxels, got {self.truncation} m with a voxel of {self.voxel} m"
            )
        for name in ("fuse_period", "refresh_period", "guess_period", "truncation_noise", "distortion"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must be zero or more, got {getattr(self, name)}")
        if self.distortion > MOST_DISTORTION:
            raise ConfigError(
                f"distortion must be at most {MOST_DISTORTION}, a share of the depth, got {self.distortion}"
            )
