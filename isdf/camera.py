"""The pinhole camera model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .errors import CameraError

# Largest |x / z| of a ray, 84 degrees from the axis (wider lenses are no pinholes), and longest focal length in image
# sizes.
STEEPEST, LONGEST = 10.0, 1e5
# Pixels of a depth camera are about square; binning one axis makes them twice or four times as long as wide.
LONGEST_PIXEL = 10.0


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole intrinsics in pixels; OpenCV axes (x right, y down, z forward), pixel centres at integers.

    Raises:
        CameraError: a focal length or a size is not positive, or a value is not finite, or they fit no lens.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        if not all(math.isfinite(v) for v in values):
            raise CameraError(f"camera intrinsics must be finite, got fx, fy, cx, cy = {values}")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(
                f"focal lengths must be positive pixels, got fx={self.fx}, fy={self.fy}; "
                "flip the image instead of the focal length"
            )
        if self.width < 1 or self.height < 1:
            raise CameraError(f"image size must be at least 1 x 1, got {self.width} x {self.height}")
        if not 1 / LONGEST_PIXEL <= self.fx / self.fy <= LONGEST_PIXEL:
            raise CameraError(
                f"fx={self.fx} and fy={self.fy} are pixels {max(self.fx / self.fy, self.fy / self.fx):.3g} times as "
                f"long as wide, at most {LONGEST_PIXEL:g} is a camera's; check the intrinsics"
            )
        for name, focal, centre, size in (
            ("x", self.fx, self.cx, self.width),
            ("y", self.fy, self.cy, self.height),
        ):
            slope = max(abs(centre), abs(size - 1 - centre)) / focal
            if slope > STEEPEST or focal > LONGEST * size:
                raise CameraError(
                    f"f{name} = {focal} and c{name} = {centre} are no pinhole camera of {size} pixels, whose rays lean "
                    f"at most {math.degrees(math.atan(STEEPEST)):.0f} degrees: focal lengths are pixels, not metres, "
                    "and the centre lies in the image or near it"
                )

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov: float) -> PinholeCamera:
        """Square pixels and a centred principal point from a horizontal field of view [rad]."""
        focal = width / (2 * math.tan(horizontal_fov / 2))
        return cls(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)

    def rays(self, pixels: Int[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        """Viewing directions K^-1 [u, v, 1] in the camera frame, with z = 1 (paper section 4.2).

        A direction times a z-depth [m] is the point seen there. `pixels` holds (u, v) = (column, row).
        """
        u, v = pixels[..., 0].float(), pixels[..., 1].float()
        return torch.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, torch.ones_like(u)], dim=-1)

    def back_project(self, depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
        """Points [m] of a whole depth image in the camera frame; invalid pixels (0) land on the origin."""
        v, u = torch.meshgrid(
            torch.arange(depth.shape[0], device=depth.device),
            torch.arange(depth.shape[1], device=depth.device),
            indexing="ij",
        )
        return self.rays(torch.stack([u, v], dim=-1)).to(depth.dtype) * depth[..., None]
