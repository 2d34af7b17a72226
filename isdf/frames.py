"""A posed depth image, checked when it is made."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .camera import PinholeCamera
from .errors import FrameError

# No depth camera for indoor robots measures a median of 60 m; 60 mm and more is every image in millimetres.
MEDIAN_DEPTH_LIMIT = 60.0
RIGID_TOLERANCE = 1e-3
# Farthest position from the origin [m]: beyond, single precision rounds points by a centimetre and more.
FARTHEST = 2e5


@dataclass(frozen=True)
class DepthFrame:
    """A depth image with the pose of the camera that took it.

    Args:
        depth: (h, w) z-depth [m], numpy or torch floating point. NaN, inf, zero and negative pixels are invalid
            and become 0.
        T_world_camera: (4, 4) rigid transform from camera to world [m], OpenCV camera axes.
        camera: the intrinsics; any object with fx, fy, cx, cy, width, height is accepted.
        time: when it was taken [s].

    Raises:
        FrameError: a wrong shape, an integer image, an image in millimetres, no valid pixel, or a pose that is
            not a rigid transform.
    """

    depth: Float[Tensor, "h w"]
    T_world_camera: Float[Tensor, "4 4"]
    camera: PinholeCamera
    time: float = field(default=0.0)

    # Written by hand so that numpy images and foreign cameras are converted before anything is stored.
    def __init__(self, depth: Any, T_world_camera: Any, camera: Any, time: float = 0.0) -> None:
        camera = as_camera(camera)
        object.__setattr__(self, "camera", camera)
        object.__setattr__(self, "depth", _as_depth(depth, camera))
        object.__setattr__(self, "T_world_camera", _as_rigid(T_world_camera))
        if not math.isfinite(time):
            raise FrameError(f"a frame's time must be finite seconds, got {time}")
        object.__setattr__(self, "time", float(time))

    @classmethod
    def of(cls, frame: Any) -> DepthFrame:
        """The frame itself, or one made of any object with `depth`, `T_world_camera` and `camera`."""
        if isinstance(frame, cls):
            return frame
        missing = [n for n in ("depth", "T_world_camera", "camera") if not hasattr(frame, n)]
        if missing:
            raise FrameError(
                f"a frame needs the attributes depth, T_world_camera and camera; {type(frame).__name__} has no "
                f"{', '.join(missing)}. Build one with isdf.DepthFrame(depth, T_world_camera, camera)"
            )
        return cls(frame.depth, frame.T_world_camera, frame.camera, float(getattr(frame, "time", 0.0)))

    def to(self, device: torch.device) -> DepthFrame:
        """The same frame on another device; itself where it is there already."""
        if self.depth.device == device:
            return self
        return DepthFrame(self.depth.to(device), self.T_world_camera.to(device), self.camera, self.time)

    def thinned(self, stride: int, max_depth: float) -> Float[Tensor, "n 3"]:
        """Surface points [m] in the world frame of every `stride`-th pixel measured within `max_depth` [m]."""
        points = self.camera.back_project(self.depth)[::stride, ::stride].reshape(-1, 3)
        points = points[(points[:, 2] > 0) & (points[:, 2] <= max_depth)]
        T = self.T_world_camera.to(points.dtype)
        return points @ T[:3, :3].T + T[:3, 3]


def as_camera(camera: Any) -> PinholeCamera:
    """The camera itself, or one made of any object with its attributes; FrameError where it has not all of them."""
    if isinstance(camera, PinholeCamera):
        return camera
    names = ("fx", "fy", "cx", "cy", "width", "height")
    missing = [n for n in names if not hasattr(camera, n)]
    if missing:
        raise FrameError(
            f"camera {type(camera).__name__} has no {', '.join(missing)}; pass an isdf.PinholeCamera(fx, fy, cx, "
            "cy, width, height)"
        )
    fx, fy, cx, cy = (float(getattr(camera, n)) for n in names[:4])
    return PinholeCamera(fx, fy, cx, cy, int(camera.width), int(camera.height))


def _as_depth(depth: Any, camera: PinholeCamera) -> Tensor:
    image = torch.as_tensor(np.array(depth) if not isinstance(depth, Tensor) else depth)
    if tuple(image.shape) != (camera.height, camera.width):
        raise FrameError(
            f"depth has shape {tuple(image.shape)}, the camera says (height, width) = "
            f"({camera.height}, {camera.width}); crop or resize the image, or correct the intrinsics"
        )
    if not image.dtype.is_floating_point:
        raise FrameError(
            f"depth must be floating-point metres, got {image.dtype}; divide the raw values by the sensor's depth "
            "scale (1000 for millimetres) first"
        )
    image = image.detach().float()
    valid = torch.isfinite(image) & (image > 0)
    if not bool(valid.any()):
        raise FrameError(
            f"the depth image has no valid pixel among {image.numel()} (all are NaN, inf, zero or negative); "
            "skip this frame"
        )
    median = float(image[valid].median())
    if median > MEDIAN_DEPTH_LIMIT:
        raise FrameError(
            f"the median depth is {median:.0f} m, which looks like millimetres; depth must be in metres "
            f"(median at most {MEDIAN_DEPTH_LIMIT:.0f} m): divide it by 1000"
        )
    return torch.where(valid, image, torch.zeros_like(image))


def _as_rigid(T: Any) -> Tensor:
    pose = torch.as_tensor(np.array(T) if not isinstance(T, Tensor) else T).detach().double()
    if tuple(pose.shape) != (4, 4):
        raise FrameError(f"T_world_camera must have shape (4, 4), got {tuple(pose.shape)}")
    if not bool(torch.isfinite(pose).all()):
        raise FrameError("T_world_camera holds NaN or inf: the tracker lost the camera; skip this frame")
    if float(pose[:3, 3].abs().max()) > FARTHEST:
        raise FrameError(
            f"the camera is at {[f'{v:.3g}' for v in pose[:3, 3].tolist()]} m; only up to {FARTHEST:.0f} m from the "
            "origin do numbers keep a centimetre. In millimetres? Else move the world's origin to the robot"
        )
    rotation = pose[:3, :3]
    error = float((rotation @ rotation.T - torch.eye(3, dtype=pose.dtype)).abs().max())
    bottom = pose[3] - torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=pose.dtype)
    if error > RIGID_TOLERANCE or torch.det(rotation) < 0 or float(bottom.abs().max()) > RIGID_TOLERANCE:
        raise FrameError(
            f"T_world_camera is not a rigid transform: |R R^T - I| is {error:.3g} (at most {RIGID_TOLERANCE}), "
            f"det R = {float(torch.det(rotation)):.3f} (must be +1), last row {pose[3].tolist()} (must be 0 0 0 1). "
            "Pass a row-major camera-to-world matrix with OpenCV axes"
        )
    return pose
