"""The exact distance field of boxes, cylinders and balls, in compiled closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from planning.errors import FieldError

KINDS = {"box": 0, "cylinder": 1, "sphere": 2}
SIZES = {"box": 3, "cylinder": 2, "sphere": 1}


class SolidArrays(NamedTuple):
    """Solids as `CompilableField.solids` describes them."""

    kind: Int[np.ndarray, " n"]
    turn: Float[np.ndarray, "n 3 3"]
    centre: Float[np.ndarray, "n 3"]
    size: Float[np.ndarray, "n 3"]
    grid: Float[np.ndarray, "nx ny nz"]
    low: Float[np.ndarray, "3"]
    voxel: float


@dataclass(frozen=True)
class Solid:
    """A box (full side lengths), a cylinder about its z axis (height, radius) or a sphere (radius).

    Args:
        kind: "box", "cylinder" or "sphere".
        dimensions: as above [m], positive.
        position: of the centre [m].
        quat_xyzw: its orientation, a quaternion that need not be normalised.

    Raises:
        FieldError: for an unknown kind, wrong or non-positive dimensions, or a pose that is not finite.
    """

    kind: str
    dimensions: tuple[float, ...]
    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise FieldError(f"Solid: kind is {self.kind!r}; accepted are {', '.join(KINDS)}.")
        if len(self.dimensions) != SIZES[self.kind] or not all(d > 0 for d in self.dimensions):
            raise FieldError(
                f"Solid: a {self.kind} needs {SIZES[self.kind]} positive dimensions [m], got {self.dimensions}."
            )
        pose = np.array([*self.position, *self.quat_xyzw])
        if pose.shape != (7,) or not np.isfinite(pose).all() or np.linalg.norm(pose[3:]) < 1e-9:
            raise FieldError(
                f"Solid: position must be 3 finite numbers and quat_xyzw 4 that are not all zero, got "
                f"{self.position} and {self.quat_xyzw}."
            )

    @property
    def size(self) -> tuple[float, float, float]:
        """Half sizes of a box; radius and half height of a cylinder; radius of a sphere [m]."""
        d = self.dimensions
        if self.kind == "box":
            return d[0] / 2, d[1] / 2, d[2] / 2
        return (d[1], d[0] / 2, 0.0) if self.kind == "cylinder" else (d[0], 0.0, 0.0)


class PrimitiveField:
    """Signed distance to the union of solids: exact outside, a lower bound of the depth where solids overlap.

    Satisfies `CompilableField`. Without any solid everything is free, 1e9 m from anything.
    """

    def __init__(self, solids: Sequence[Solid]) -> None:
        self.solids = SolidArrays(
            np.array([KINDS[s.kind] for s in solids], np.int64),
            np.array([_rotation(s.quat_xyzw).T for s in solids]).reshape(-1, 3, 3),
            np.array([s.position for s in solids], np.float64).reshape(-1, 3),
            np.array([s.size for s in solids], np.float64).reshape(-1, 3),
            np.zeros((0, 0, 0), np.float32),
            np.zeros(3),
            1.0,
        )

    @cached_property
    def _compiled(self):  # type: ignore[no-untyped-def]
        from planning.compiled.arrays import solids_of

        return solids_of(self)

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distances [m] at points [m], differentiable once by autograd."""
        value: Tensor = _Distance.apply(points, self)
        return value

    def distance_and_gradient(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distances [m] and their unit gradients at points [m], without an autograd graph."""
        from planning.compiled.solids import distances_and_gradients

        flat = points.detach().reshape(-1, 3).double().numpy()
        distance, gradient = distances_and_gradients(self._compiled, flat)
        return (
            torch.from_numpy(distance).to(points).view(points.shape[:-1]),
            torch.from_numpy(gradient).to(points).view(points.shape),
        )


class _Distance(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points: Tensor, field: PrimitiveField) -> Tensor:  # type: ignore[no-untyped-def]
        distance, gradient = field.distance_and_gradient(points)
        ctx.save_for_backward(gradient)
        return distance

    @staticmethod
    def backward(ctx, above: Tensor) -> tuple[Tensor, None]:  # type: ignore[no-untyped-def]
        (gradient,) = ctx.saved_tensors
        return above.unsqueeze(-1) * gradient, None


def _rotation(quat_xyzw: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    x, y, z, w = np.asarray(quat_xyzw, np.float64) / np.linalg.norm(quat_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
