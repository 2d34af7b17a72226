"""Cover a shape with balls that protrude little: grown ball by ball, all centres moved together.

A ball about an interior point c at depth d(c) with radius d(c) + h protrudes at most h from the shape,
because the distance function grows no faster than the way travelled. For given centres the least common h
that covers all points p is

    h = max_p min_i ( |p - c_i| - d(c_i) ),

a minimax facility-location problem, whose inner term is convex in c_i for a convex shape. It is descended
with soft maxima and minima that harden as it goes; each further ball starts where the cover is worst.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from robots.convex_shape import Shape
from robots.errors import RobotError

COVER_POINTS = 1_200  # surface points that each descent step looks at,
WORST_POINTS = 500  # beside those of the check points that are covered worst at the time
CHECK_POINTS = 12_000  # surface points that h is measured on
BAD_POINTS = 1_000  # check points covered worst, which a further ball is to relieve
EASED = 0.6  # share of the worst need below which relieving a point further counts for nothing
INNER_POINTS = 300  # interior points that must be covered too, so that no hole opens inside of a big shape
CANDIDATES = 500  # interior points drawn, from which a further ball starts
GROW_STEPS = 50  # descent steps after each further ball,
POLISH_STEPS = 400  # and at the end
SOFTNESS = (2e-3, 2e-4)  # [m] of maxima and minima, first and last
STEP = (2e-3, 6e-5)  # [m] of the descent, first and last
HEIGHT_WEIGHT = 40.0  # a ball that reaches below the height limit counts as protruding by so much more


class BallCover:
    """Balls that cover a shape but for a small gap, and how far they protrude.

    Args:
        shape: what to cover.
        lowest: height [m, frame of the shape] that no ball may go below.
        gap: distance [m] that surface points may stay away from the balls; cutting the corners saves many.
        seed: of the samples.

    Raises `RobotError` where the shape itself reaches below `lowest`.
    """

    def __init__(self, shape: Shape, lowest: float | None = None, gap: float = 0.0, seed: int = 0) -> None:
        if lowest is not None and shape.bounds[0, 2] < lowest:
            raise RobotError(
                f"the shape reaches down to {shape.bounds[0, 2]:.3f} m, below the limit lowest = {lowest:.3f} m; "
                "no spheres above it can cover the shape: give a lower `lowest`"
            )
        self.shape = shape
        self.gap = gap
        self._lowest = -math.inf if lowest is None else lowest
        self._planes = [(_tensor(normals), _tensor(offsets)) for normals, offsets in shape.planes]
        inner = shape.interior_points(INNER_POINTS)
        self._points = _tensor(np.concatenate([shape.surface_points(COVER_POINTS), inner]))
        self._check = _tensor(np.concatenate([shape.surface_points(CHECK_POINTS), inner]))
        self._candidates = _tensor(shape.inner_centres(CANDIDATES))
        widest = self._needs(self._points, self._candidates).amax(0)
        self._centres = self._candidates[widest.argmin()][None]
        self._raw = math.inf
        self._descend(GROW_STEPS)

    def __len__(self) -> int:
        return len(self._centres)

    @property
    def overshoot(self) -> float:
        """How far [m] the balls protrude at most."""
        return max(self._raw - self.gap, 0.0)

    def add(self) -> None:
        """Start another ball where it relieves the badly covered points most, then move all."""
        need = self._needs(self._check, self._centres).amin(1)
        bad, worst = need.topk(min(BAD_POINTS, len(need)))
        eased = self._needs(self._check[worst], self._candidates).clamp(min=EASED * float(bad[0]))
        gain = (bad[:, None] - eased).clamp(min=0).sum(0)
        self._centres = torch.cat([self._centres, self._candidates[gain.argmax()][None]])
        self._descend(GROW_STEPS)

    @property
    def centres(self) -> Tensor:
        """Centres (n, 3) [m]."""
        return self._centres

    def restart(self, centres: Tensor) -> None:
        """Go on from other centres (n, 3) [m], such as those of an earlier state, and move them with patience."""
        self._centres, self._raw = centres, math.inf
        self._descend(POLISH_STEPS)

    def balls(self) -> np.ndarray:
        """Spheres (n, 4) of centre and radius [m]; each only as large as the points that it alone must contain."""
        need = torch.cdist(self._check, self._centres)
        radii = self._radii()
        for _ in range(3):
            owner = (need - radii).argmin(1)
            owned = need.masked_fill(torch.arange(len(radii)) != owner[:, None], 0.0)
            radii = owned.amax(0)
        kept = radii > self.gap
        spheres = torch.column_stack([self._centres, radii - self.gap])[kept]
        return spheres.double().numpy()

    def _descend(self, steps: int) -> None:
        """Adam on the softened h, the best centres on the check points kept."""
        centres = self._centres.clone().requires_grad_()
        optimiser = torch.optim.Adam([centres], betas=(0.8, 0.95))
        points = self._watched(centres)
        for step in range(steps):
            share = step / steps
            softness, rate = (first * (last / first) ** share for first, last in (SOFTNESS, STEP))
            optimiser.param_groups[0]["lr"] = rate
            needs = self._needs(points, centres, softness)
            need = -softness * torch.logsumexp(-needs / softness, 1)
            loss = softness * torch.logsumexp(need / softness, 0)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            if (step + 1) % 25 == 0 or step + 1 == steps:
                points = self._watched(centres)

    @torch.no_grad()
    def _watched(self, centres: Tensor) -> Tensor:
        """Measure h for these centres, keep them if it is the least so far; returns points to descend on."""
        need = self._needs(self._check, centres).amin(1)
        overshoot = float(need.max())
        if overshoot < self._raw:
            self._centres, self._raw = centres.detach().clone(), overshoot
        return torch.cat([self._points, self._check[need.topk(min(WORST_POINTS, len(need))).indices]])

    def _needs(self, points: Tensor, centres: Tensor, softness: float = 0.0) -> Tensor:
        """How far (p, n) [m] each ball would have to protrude to contain each point."""
        distance = torch.cdist(points, centres)
        need = distance - self._depth(centres, softness)
        if math.isinf(self._lowest):
            return need
        return torch.maximum(need, HEIGHT_WEIGHT * (distance - (centres[:, 2] - self._lowest)))

    def _radii(self) -> Tensor:
        """Radii (n,) [m] with which the balls protrude by the overshoot, `lowest` counting as part of the shape."""
        height = self._centres[:, 2] - self._lowest + self._raw / HEIGHT_WEIGHT
        return torch.minimum(self._depth(self._centres) + self._raw, height)

    def _depth(self, centres: Tensor, softness: float = 0.0) -> Tensor:
        """Depth (n,) [m] of centres in the piece that they lie deepest in, as `Shape.depth`."""
        depths = [_least(offsets - centres @ normals.T, softness) for normals, offsets in self._planes]
        return -_least(-torch.stack(depths, dim=-1), softness)


def _least(values: Tensor, softness: float) -> Tensor:
    """Minimum along the last dimension, softened [m]."""
    return values.amin(-1) if softness == 0 else -softness * torch.logsumexp(-values / softness, -1)


def _tensor(array: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(array), dtype=torch.float32)
