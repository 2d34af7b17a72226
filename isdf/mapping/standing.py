"""What stands on the floor though the camera sees only its upper part."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from .bricks import SIDE, Bricks
from .evidence import BAND

# Nobody's feet are more than so many places under what is seen of him. A place is as large as two coarse nodes a side.
TALL = 6
# Fewer pixels in a column of places show nobody, but the edge of something that was overlooked.
MANY = 50


def vertical(up: Float[np.ndarray, "3"]) -> tuple[int, int]:
    """The vertical axis, and 1 if it points up, else -1."""
    axis = int(np.abs(up).argmax())
    return axis, 1 if up[axis] > 0 else -1


def corners(places: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "2 3"]:
    """First, and one past the last, of the bricks."""
    return np.stack([places.min(axis=0), places.max(axis=0) + 1])


def feet(
    pixels: Int[np.ndarray, "nx ny nz"],
    inside: Bool[np.ndarray, "nx ny nz"],
    axis: int,
    way: int,
    ground: int,
) -> Int[np.ndarray, "n 5"]:
    """The lowest places where somebody was seen, and how many of them under each the floor is; none where it is far.

    Where he was seen in the place above, too, that one is taken instead, with a 1 behind it, else a 0: the edge of the
    image cuts off more of what is near, and he may have been seen above only.

    Args:
        pixels: how many show somebody in each place.
        inside: these may be changed.
        axis: the vertical.
        way: 1 if the axis points up, else -1.
        ground: index of the places of the floor along that axis.
    """
    lowest: dict[tuple[int, ...], np.ndarray] = {}
    many = np.maximum(pixels, 0).sum(axis=axis, keepdims=True) >= MANY
    for place in np.argwhere((pixels > 0) & many):
        column = tuple(int(n) for n in np.delete(place, axis))
        if column not in lowest or way * place[axis] < way * lowest[column][axis]:
            lowest[column] = place
    out = [np.empty((0, 5), dtype=np.int64)]
    for place in lowest.values():
        steps, end, above = way * (place[axis] - ground), place.copy(), place.copy()
        end[axis], above[axis] = ground, place[axis] + way
        if 0 < steps <= TALL and 0 <= ground < pixels.shape[axis] and inside[tuple(end)]:
            too = 0 <= above[axis] < pixels.shape[axis] and pixels[tuple(above)] > 0
            out.append(np.array([[*above, steps + 1, 1] if too else [*place, steps, 0]]))
    return np.concatenate(out)


def parts(feet: Int[np.ndarray, "n 5"], side: int, axis: int, way: int) -> Int[np.ndarray, "m 5"]:
    """The same for bricks, `side` of them a side of a place: the highest brick of each column in these places."""
    across = np.argwhere(np.ones((side, side), dtype=bool))
    offsets = np.insert(across, axis, side - 1 if way > 0 else 0, axis=1)
    first = (side * feet[:, None, :3] + offsets).reshape(-1, 3)
    down = np.column_stack([side * feet[:, 3] + side - 1, side * feet[:, 4]])
    return np.column_stack([first, np.repeat(down, len(offsets), axis=0)])


def columns(feet: Int[np.ndarray, "n 5"], axis: int, way: int) -> Int[np.ndarray, "m 3"]:
    """Indices of the places, or bricks, from those of `feet` down so many steps."""
    out = [np.empty((0, 3), dtype=np.int64)]
    for *place, steps, _ in feet:
        column = np.tile(np.array(place), (steps + 1, 1))
        column[:, axis] -= way * np.arange(steps + 1)
        out.append(column)
    return np.concatenate(out)


@njit(cache=True, nogil=True)
@no_type_check
def extend_down(bricks: Bricks, feet, own, axis, way, depth, intrinsics, T_camera_world):
    """Go on downwards with the lowest distances of some bricks, but where the image looks.

    Args:
        bricks: changed and counted; all that is below is stored.
        feet: (n, 5) array index of each of the bricks, how many bricks to go down, and how many of these are above the
            lowest place: what ends in them has to be cut off by the edge of the image, not hidden.
        own: so many bricks of the lowest place have been seen themselves.
        axis: the vertical.
        way: 1 if the axis points up, else -1.
        depth: (h, w) float32 z-depth [m], 0 = unknown.
        intrinsics: fx, fy, cx, cy.
        T_camera_world: (4, 4).
    """
    fx, fy, cx, cy = intrinsics
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    table, corner, distances, weights, ended, voxel, changes = bricks
    across = np.array([1, 2]) if axis == 0 else (np.array([0, 2]) if axis == 1 else np.array([0, 1]))
    brick, local, point = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    for n in range(feet.shape[0]):
        for p in range(SIDE):
            for q in range(SIDE):
                value, weight, end, above = np.float32(0), np.float32(0), np.float32(0), False
                for layer in range(SIDE - 1, -SIDE * feet[n, 3] - 1, -1):
                    for a in range(3):
                        brick[a] = feet[n, a]
                    down = -(layer // SIDE)
                    brick[axis] -= way * down
                    local[across[0]], local[across[1]] = p, q
                    height = layer + SIDE * down
                    local[axis] = height if way > 0 else SIDE - 1 - height
                    row = table[brick[0], brick[1], brick[2]]
                    at = local[0] * 64 + local[1] * 8 + local[2]
                    if down < feet[n, 4] + own and weights[row, at] > 0:
                        above = down < feet[n, 4]
                        value, weight, end = distances[row, at], weights[row, at], ended[row, at]
                        continue
                    if weight <= 0:
                        continue
                    for a in range(3):
                        point[a] = voxel * (SIDE * (corner[a] + brick[a]) + local[a])
                    z = R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2] + t[2]
                    if z > 0.05:
                        x = R[0, 0] * point[0] + R[0, 1] * point[1] + R[0, 2] * point[2] + t[0]
                        y = R[1, 0] * point[0] + R[1, 1] * point[1] + R[1, 2] * point[2] + t[1]
                        u, v = int(np.floor(x / z * fx + cx + 0.5)), int(np.floor(y / z * fy + cy + 0.5))
                        looked_at = 0 <= u < depth.shape[1] and 0 <= v < depth.shape[0]
                        if looked_at and (above or depth[v, u] > z - BAND):
                            continue
                    if weights[row, at] <= 0 or distances[row, at] > value:
                        distances[row, at], weights[row, at], ended[row, at] = value, weight, end
                        changes[row] += 1
