"""From a path that slides a base sideways to one that wheels can follow: turn, drive along it, turn."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from planning.path_reference import wrapped

STILL = 0.01  # [m]: a base that moves less in all stays where it is
SPACING = 0.05  # [m] of the base's path
TURN = 0.1  # [rad] of a turn on the spot


def driveable(
    path: Float[ndarray, "n dof"], base: Sequence[int], backwards: bool
) -> tuple[Float[ndarray, "m dof"], Float[ndarray, " m-1"]]:
    """The same positions of the base and postures of the arm, with the base's yaw along its way.

    Args:
        path: configurations [rad | m].
        base: columns of base x, y and yaw.
        backwards: drive in reverse.

    Returns:
        Configurations, the last one with the path's last yaw up to whole turns, and the signed distances [m]
        between them. Exact for wheels but for the bends at vertices.
    """
    x, y, yaw = base
    along = _by_arc_length(path, base)
    if along is None:
        return path.copy(), np.zeros(len(path) - 1)
    step = np.diff(along[:, [x, y]], axis=0)
    directions = np.arctan2(step[:, 1], step[:, 0]) + (math.pi if backwards else 0.0)
    directions = np.unwrap(np.r_[path[0, yaw], directions])[1:]
    # The yaw at a vertex is the mean of the two segments', so that those between vertices are nearly along them.
    along[1:-1, yaw] = (directions[:-1] + directions[1:]) / 2
    along[0, yaw], along[-1, yaw] = directions[0], directions[-1]
    end = along[-1].copy()
    end[yaw] += wrapped(path[-1, yaw] - end[yaw])
    driven = np.linalg.norm(step, axis=1) * (-1 if backwards else 1)
    first, last = _turn(path[0], along[0]), _turn(along[-1], end)
    distances = np.r_[np.zeros(len(first) - 1), driven, np.zeros(len(last) - 1)]
    return np.concatenate([first[:-1], along, last[1:]]), distances


def _by_arc_length(path: Float[ndarray, "n dof"], base: Sequence[int]) -> Float[ndarray, "m dof"] | None:
    """The path at even distances of the base; what moves while it stands is left to the stretch before."""
    lengths = np.linalg.norm(np.diff(path[:, list(base[:2])], axis=0), axis=1)
    arc = np.r_[0.0, np.cumsum(lengths)]
    if arc[-1] < STILL:
        return None
    kept = np.r_[True, lengths > 1e-6]
    kept[-1] = kept[-1] or arc[-1] > arc[kept][-1]
    knots, values = arc[kept], path[kept].copy()
    values[-1] = path[-1]
    grid = np.linspace(0.0, arc[-1], max(2, math.ceil(arc[-1] / SPACING) + 1))
    return np.stack([np.interp(grid, knots, column) for column in values.T], axis=1)


def _turn(start: Float[ndarray, " dof"], end: Float[ndarray, " dof"]) -> Float[ndarray, "k dof"]:
    """Steps from one configuration to another."""
    count = max(1, math.ceil(float(np.abs(end - start).max()) / TURN))
    return start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start)
