"""Pictures of a distance field at constant height, with the camera's path and keyframes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from .errors import ConfigError
from .slice_geometry import corners, slice_basis

# Of the same order as the distance at which planners stop caring; farther away all blues look the same.
COLOUR_LIMIT = 1.5
# In a small region the colours end at this share of its longer side.
COLOUR_SHARE = 0.25
# How much it counts that up is where the tops of the images are, against that their right sides are level.
HELD = 0.01
# Picture elements along the longer side of a slice in a notebook.
ELEMENTS = 250


class SliceFigure(Figure):
    """A figure that notebooks show inline, whether or not pyplot was imported."""

    def _repr_png_(self) -> bytes:
        data = io.BytesIO()
        self.savefig(data, format="png", dpi=110)
        return data.getvalue()


def estimate_up(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "3"]:
    """The world's up direction, judged by how the cameras were held.

    People and robots hold cameras level: however far they look down, the right of the image is horizontal. Where it
    never turns, the mean of the image's up direction decides. It snaps to the nearest axis when within 12 degrees,
    since most worlds are aligned with gravity.
    """
    poses = np.asarray(poses)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    right, held = poses[:, :3, 0], -poses[:, :3, 1].mean(axis=0)
    held /= np.linalg.norm(held)
    _, directions = np.linalg.eigh(right.T @ right / len(right) - HELD * np.outer(held, held))
    up = directions[:, 0] if directions[:, 0] @ held >= 0 else -directions[:, 0]
    axis = int(np.abs(up).argmax())
    if abs(up[axis]) > np.cos(np.radians(12)):
        up = np.sign(up[axis]) * np.eye(3)[axis]
    return np.asarray(up)


def draw_slice(
    axes: Axes,
    field: Any,
    height: float,
    up: Float[np.ndarray, "3"],
    poses: Float[np.ndarray, "n 4 4"] | None = None,
    keyframes: Float[np.ndarray, "k 3"] | None = None,
    spacing: float = 0.02,
    bounds: Float[Tensor, "2 3"] | None = None,
    grey_unknown: bool = True,
) -> Any:
    """Draw one slice into matplotlib axes; returns the image for a colour bar.

    Args:
        axes: where to draw; in metres along the two horizontal directions of `slice_basis(up)`.
        field: a distance field; with `bounds`, unless these are given.
        height: along `up` [m].
        up: unit vector.
        poses: T_world_camera of the whole path, drawn as a line.
        keyframes: camera positions to mark [m].
        spacing: size of a picture element [m].
        bounds: (2, 3) region [m]; by default the field's.
        grey_unknown: draw grey where the field's `confidence`, if it has one, is below one half.
    """
    basis = slice_basis(up)
    box = corners((field.bounds if bounds is None else bounds).cpu().numpy()) @ basis.T
    (x0, y0, _), (x1, y1, _) = box.min(axis=0) - 0.2, box.max(axis=0) + 0.2
    xs, ys = np.arange(x0, x1, spacing), np.arange(y0, y1, spacing)
    grid = (
        np.stack([*np.meshgrid(xs, ys, indexing="xy"), np.full((len(ys), len(xs)), height)], axis=-1) @ basis
    )
    points = torch.from_numpy(grid.astype(np.float32))
    distance = field.distance(points).cpu().numpy()
    limit = min(COLOUR_LIMIT, COLOUR_SHARE * float(np.ptp(box, axis=0)[:2].max()))
    if grey_unknown and hasattr(field, "confidence"):
        distance = np.where(field.confidence(points).cpu().numpy() >= 0.5, distance, np.nan)
    image = axes.imshow(
        distance,
        origin="lower",
        extent=(x0, x1, y0, y1),
        cmap="coolwarm_r",
        vmin=-limit,
        vmax=limit,
    )
    axes.set_facecolor("0.75")
    axes.contour(xs, ys, distance, levels=[0.0], colors="black", linewidths=1.2)
    if poses is not None:
        path = np.asarray(poses)[:, :3, 3] @ basis.T
        axes.plot(path[:, 0], path[:, 1], color="red", linewidth=1.0)
    if keyframes is not None and len(keyframes):
        at = np.asarray(keyframes) @ basis.T
        axes.plot(at[:, 0], at[:, 1], "o", color="limegreen", markersize=4, markeredgecolor="black")
    axes.set_aspect("equal")
    axes.set_title(f"height {height:.2f} m")
    return image


def save_slices(
    path: str | Path,
    field: Any,
    heights: list[float],
    up: Float[np.ndarray, "3"],
    poses: Float[np.ndarray, "n 4 4"] | None = None,
    keyframes: Float[np.ndarray, "k 3"] | None = None,
) -> None:
    """One picture with a slice for every height, zero level in black, camera path in red, keyframes in green."""
    across = np.ptp(corners(field.bounds.cpu().numpy()) @ slice_basis(up).T, axis=0)
    figure = Figure(figsize=(5 * len(heights) + 1, 5 * across[1] / across[0] + 0.9), layout="constrained")
    axes = figure.subplots(1, len(heights), squeeze=False)[0]
    for ax, height in zip(axes, heights, strict=True):
        image = draw_slice(ax, field, height, up, poses, keyframes)
        ax.set_xlabel("[m]")
    figure.colorbar(image, ax=list(axes), label="signed distance [m]", shrink=0.8)
    figure.savefig(path, dpi=110)


def slice_figure(
    field: Any,
    height: float | None,
    up: Float[np.ndarray, "3"],
    poses: Float[np.ndarray, "n 4 4"] | None,
    spacing: float | None,
    bounds: Float[Tensor, "2 3"] | None,
    grey_unknown: bool,
) -> SliceFigure:
    """What `isdf.plot_slice` returns; its arguments, in its order."""
    if not 0 < np.linalg.norm(up) < np.inf:
        raise ConfigError(f"up must be a direction, got {tuple(up)}")
    up = up / np.linalg.norm(up)
    box = corners((field.bounds if bounds is None else bounds).cpu().numpy()) @ slice_basis(up).T
    across = np.ptp(box, axis=0)
    middle = float(box[:, 2].mean()) if height is None else height
    spacing = spacing or float(across[:2].max()) / ELEMENTS
    figure = SliceFigure(figsize=(6.5, 5.2 * across[1] / across[0] + 0.9), layout="constrained")
    axes = figure.subplots()
    image = draw_slice(axes, field, middle, up, poses, None, spacing, bounds, grey_unknown)
    axes.set_xlabel("[m]")
    figure.colorbar(image, ax=axes, label="signed distance [m]", shrink=0.8)
    return figure


def slice_heights(field: Any, up: Float[np.ndarray, "3"], count: int = 3) -> list[float]:
    """Heights [m] that divide the observed height range evenly, its ends left out."""
    along = corners(field.bounds.cpu().numpy()) @ up
    return [float(h) for h in np.linspace(along.min(), along.max(), count + 2)[1:-1]]
