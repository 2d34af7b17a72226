"""A map and an image as pictures: slices in diverging colours with their zero contour, depth in shades."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8

from ..slice_geometry import corners, slice_basis

Quantity = Literal["distance", "confidence"]
COLOUR_LIMIT = 0.8
"""Distance [m] at which colours end."""
ELEMENTS, LEAST_SPACING = 260, 0.02
"""Picture elements along the longer side of a slice, and their least size [m]."""
BEYOND = 0.2
"""What is shown round the mapped area [m]."""
UNSURE = 0.35
"""Opacity where the map is not sure of anything."""


@dataclass(frozen=True)
class Slice:
    """A picture of a field at one height.

    Args:
        image: (h, w, 4) red, green, blue, opacity; the first row lies at the far end of the second direction.
        centre: (3,) of the picture [m].
        axes: (3, 3) rows: the picture's directions to the right and up, and its normal.
        size: width and height [m].
    """

    image: UInt8[np.ndarray, "h w 4"]
    centre: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    size: tuple[float, float]


def slice_picture(
    field: Any, height: float, up: Float[np.ndarray, "3"], quantity: Quantity = "distance", fade: bool = True
) -> Slice:
    """Draw a distance field over its bounds.

    Args:
        field: with `bounds`, and `confidence` where it has one.
        height: along `up` [m].
        up: unit vector.
        quantity: what the colours say.
        fade: fainter where the confidence is lower.
    """
    basis = slice_basis(up)
    box = corners(field.bounds.cpu().numpy()) @ basis.T
    low, high = box.min(axis=0)[:2] - BEYOND, box.max(axis=0)[:2] + BEYOND
    spacing = max(LEAST_SPACING, float((high - low).max()) / ELEMENTS)
    xs = np.arange(low[0] + spacing / 2, high[0], spacing)
    ys = np.arange(low[1] + spacing / 2, high[1], spacing)[::-1]
    flat = np.stack([*np.meshgrid(xs, ys), np.full((len(ys), len(xs)), height)], axis=-1)
    points = torch.from_numpy((flat @ basis).astype(np.float32))
    distance = field.distance(points).cpu().numpy()
    sure = confidence_of(field, points)
    image = _distance_colours(distance, spacing) if quantity == "distance" else _share_colours(sure)
    opacity = UNSURE + (1 - UNSURE) * np.clip(sure, 0, 1) if fade else np.ones_like(sure)
    image[..., 3] = np.round(200 * opacity)
    middle = np.array([(xs[0] + xs[-1]) / 2, (ys[0] + ys[-1]) / 2, height]) @ basis
    return Slice(image, middle, basis, (len(xs) * spacing, len(ys) * spacing))


def confidence_of(field: Any, points: torch.Tensor) -> np.ndarray:
    """Confidences (...,) at points (..., 3); 1 of a field that has none."""
    if not hasattr(field, "confidence"):
        return np.ones(points.shape[:-1], np.float32)
    return field.confidence(points).cpu().numpy()


def depth_picture(depth: Any, farthest: float = 5.0, width: int = 320) -> UInt8[np.ndarray, "h w 3"]:
    """A depth image (h, w) [m] in colours, near bright and far dark, black where nothing was measured."""
    depth = np.asarray(depth)
    depth = depth[:: max(1, depth.shape[1] // width), :: max(1, depth.shape[1] // width)]
    shades = _map("magma")(1.0 - 0.85 * np.clip(depth / farthest, 0, 1))[..., :3]
    return np.where(depth[..., None] > 0, np.round(255 * shades), 0).astype(np.uint8)


def _distance_colours(distance: np.ndarray, spacing: float) -> np.ndarray:
    """Red inside, blue outside, black where the sign changes between neighbours."""
    image = np.round(255 * _map("coolwarm_r")(0.5 + 0.5 * distance / COLOUR_LIMIT)).astype(np.uint8)
    inside = distance < 0
    contour = np.zeros_like(inside)
    contour[:, 1:] |= inside[:, 1:] != inside[:, :-1]
    contour[1:] |= inside[1:] != inside[:-1]
    image[contour] = (0, 0, 0, 255)
    return image


def _share_colours(share: np.ndarray) -> np.ndarray:
    return np.round(255 * _map("viridis")(share)).astype(np.uint8)


def _map(name: str) -> Any:
    from matplotlib import colormaps

    return colormaps[name]
