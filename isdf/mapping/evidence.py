"""What the views so far prove about every node of a coarse lattice: an upper and a lower bound of its distance.

The distance to the closest surface point seen so far is an upper bound (the paper's batch bound, taken over everything
seen instead of a batch). Space seen to be free gives the lower bound: nothing can be nearer than the closest place that
was not looked at. Where the two meet the distance is known; between them it has to be guessed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit

from .nearest import nearest_points

# A node closer than this to a seen surface, and not seen to be free, is part of that surface [nodes].
SURFACE_REACH = 1.06
# Evidence of a node: one view through it makes it free, this many views that end before it take that back.
FREE, FREE_ABOVE, DOUBT = 255, 127, 16
# A view ends this far before the measured depth [m], plus NOISE times its square.
MARGIN, NOISE = 0.04, 0.01
# How far behind a measured surface a node is contradicted [m].
BAND = 0.12
# The same behind something that has just appeared [m].
INSIDE = 0.6


@njit(cache=True, nogil=True)
@no_type_check
def look_through(free, corner, spacing, begin, end, depth, appeared, stride, intrinsics, T_camera_world):
    """Mark the nodes of a box that a depth image looks through.

    Args:
        free: (nx, ny, nz) uint8 evidence, changed in place.
        corner: (3,) lattice index of node (0, 0, 0); node n lies at spacing * (corner + n).
        spacing: of the nodes [m].
        begin: (3,) first node of the box.
        end: (3,) one past its last node.
        depth: (h, w) float32 z-depth [m], 0 where unknown.
        appeared: (h / stride, w / stride) bool: something is measured there where space was free.
        stride: in pixels.
        intrinsics: fx, fy, cx, cy.
        T_camera_world: (4, 4).
    """
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    for i in range(begin[0], end[0]):
        x = spacing * (corner[0] + i)
        for j in range(begin[1], end[1]):
            y = spacing * (corner[1] + j)
            for k in range(begin[2], end[2]):
                w = spacing * (corner[2] + k)
                z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * w + t[2]
                if z < 0.05:
                    continue
                u = int(np.floor(fx * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * w + t[0]) / z + cx + 0.5))
                v = int(np.floor(fy * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * w + t[1]) / z + cy + 0.5))
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                ahead = depth[v, u] - z
                if depth[v, u] <= 0:
                    continue
                if ahead > MARGIN + NOISE * z * z:
                    free[i, j, k] = FREE
                elif ahead < 0 and free[i, j, k] > 0:
                    # What stands where space was free hides what is in it, too, not only its front.
                    if ahead > -INSIDE and appeared[v // stride, u // stride]:
                        free[i, j, k] = max(0, free[i, j, k] - 4 * DOUBT)
                    elif ahead > -BAND:
                        free[i, j, k] = max(0, free[i, j, k] - DOUBT)


@dataclass(frozen=True)
class Bounds:
    """Bounds at the nodes of a window of the coarse lattice.

    Args:
        upper: distance to the closest surface point seen so far [m].
        lower: distance to the closest node that was not looked at [m], never above `upper`; in space not looked at
            minus the distance to the closest free node.
        free: looked through.
        unknown: neither looked through nor at a surface.
        nearest: index of the closest surface point.
    """

    upper: Float[np.ndarray, "nx ny nz"]
    lower: Float[np.ndarray, "nx ny nz"]
    free: Bool[np.ndarray, "nx ny nz"]
    unknown: Bool[np.ndarray, "nx ny nz"]
    nearest: Int[np.ndarray, "nx ny nz"]


@dataclass(frozen=True)
class Evidence(Bounds):
    """The bounds and what else the network goes by.

    Args:
        direction: unit vector to the closest surface point.
        height: above the lowest surfaces seen [m].
    """

    direction: Float[np.ndarray, "nx ny nz 3"]
    height: Float[np.ndarray, "nz"]


def gather(
    seeds: Float[np.ndarray, "n 3"],
    evidence: UInt8[np.ndarray, "nx ny nz"],
    corner: np.ndarray,
    spacing: float,
) -> Evidence:
    """Bounds from surface points [m] and free evidence, and where the closest of the points lie.

    Args:
        seeds: (n, 3) float32 surface points in world coordinates [m]; at least one.
        evidence: of the nodes of the window.
        corner: lattice index of its first node.
        spacing: of the nodes [m].
    """
    shape = evidence.shape
    proven = bounds(seeds, evidence, corner, spacing)
    nodes = np.stack(np.meshgrid(*[np.arange(n, dtype=np.float32) for n in shape], indexing="ij"), axis=-1)
    reach = np.maximum(proven.upper / np.float32(spacing), 1e-3)
    direction = (_in_nodes(seeds, corner, spacing)[proven.nearest] - nodes) / reach[..., None]
    floor = np.partition(seeds[:, 2], len(seeds) // 50)[len(seeds) // 50]
    height = (spacing * (corner[2] + np.arange(shape[2])) - floor).astype(np.float32)
    return Evidence(**vars(proven), direction=direction, height=height)


def bounds(
    seeds: Float[np.ndarray, "n 3"],
    evidence: UInt8[np.ndarray, "nx ny nz"],
    corner: np.ndarray,
    spacing: float,
) -> Bounds:
    """The bounds alone; arguments as for `gather`."""
    everywhere = np.ones(evidence.shape, dtype=np.bool_)
    nearest, square = nearest_points(_in_nodes(seeds, corner, spacing), everywhere)
    upper = np.sqrt(square)
    free = evidence > FREE_ABOVE
    unknown = ~free & (upper > SURFACE_REACH)
    lower = _lower(free, unknown, upper)
    return Bounds(upper * np.float32(spacing), lower * np.float32(spacing), free, unknown, nearest)


def _in_nodes(seeds: np.ndarray, corner: np.ndarray, spacing: float) -> Float[np.ndarray, "n 3"]:
    return (seeds / np.float32(spacing) - corner).astype(np.float32)


def _lower(free: np.ndarray, unknown: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Signed distance to the border between space looked through and space not looked at [nodes]."""
    exposed = np.argwhere(_beside(unknown, free)).astype(np.float32)
    rim = np.argwhere(_beside(free, unknown)).astype(np.float32)
    if len(exposed) == 0:
        return np.where(free, upper, -upper)
    # The border runs halfway between a free node and an unknown one, and no way to it leads across it.
    inside = np.sqrt(nearest_points(exposed, ~unknown)[1]) - np.float32(0.5)
    outside = np.sqrt(nearest_points(rim, ~free)[1]) - np.float32(0.5)
    # At a surface but not looked through, a node may lie on either side.
    lower = np.where(unknown, -outside, np.where(free, inside, -upper))
    return np.minimum(lower, upper)


def _beside(these: np.ndarray, those: np.ndarray) -> np.ndarray:
    """Which of these nodes have one of those among their 26 neighbours."""
    grown = those
    for axis in range(3):
        lines = np.moveaxis(grown, axis, 0)
        wider = lines.copy()
        wider[1:] |= lines[:-1]
        wider[:-1] |= lines[1:]
        grown = np.moveaxis(wider, 0, axis)
    return these & grown
