"""How fields and maps show themselves: a line in a prompt, and in a notebook a slice as well."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from .errors import NotReadyError

if TYPE_CHECKING:
    from .slices import SliceFigure


def plot_slice(
    field: Any,
    height: float | None = None,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    poses: Float[np.ndarray, "n 4 4"] | None = None,
    spacing: float | None = None,
    bounds: Float[Tensor, "2 3"] | None = None,
    grey_unknown: bool = True,
) -> SliceFigure:
    """A figure of a distance field at one height: red inside, blue outside, zero in black; notebooks show it inline.

    Args:
        field: any distance field; with `bounds`, unless these are given.
        height: along `up` [m]; by default the middle of the bounds.
        up: direction of the world, of any length.
        poses: T_world_camera (n, 4, 4), whose path is drawn in red.
        spacing: size of a picture element [m]; by default a 250th of the longer side.
        bounds: (2, 3) region to draw [m]; by default the field's.
        grey_unknown: draw grey where the field's `confidence`, if it has one, is below one half.

    Returns:
        A matplotlib figure; `figure.savefig(path)` writes it.
    """
    from .slices import slice_figure

    return slice_figure(field, height, np.asarray(up, dtype=float), poses, spacing, bounds, grey_unknown)


class ShownField:
    """A field with `bounds` that notebooks show as a slice at half its height."""

    bounds: Float[Tensor, "2 3"]

    def plot_slice(self, height: float | None = None, **options: Any) -> SliceFigure:
        """A figure at one height [m]; options as of `isdf.plot_slice`."""
        return plot_slice(self, height, **options)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} over {size_of(self.bounds)}>"

    def _repr_png_(self) -> bytes:
        return self.plot_slice()._repr_png_()


class ShownMapper:
    """A mapper that says how far it is, and that notebooks show as a slice of its field."""

    config: Any
    frames_seen: int
    steps: int

    def __repr__(self) -> str:
        if self.frames_seen == 0:
            return f"<{type(self).__name__}: no frame yet>"
        steps = f", {self.steps} steps" if self.steps else ""
        return f"<{type(self).__name__}: {self.frames_seen} frames{steps}, {size_of(self.bounds)} seen>"  # type: ignore[attr-defined]

    def _repr_png_(self) -> bytes | None:
        try:
            field = self.field()  # type: ignore[attr-defined]
        except NotReadyError:
            return None
        return plot_slice(field)._repr_png_()


def size_of(bounds: Float[Tensor, "2 3"]) -> str:
    """Sides of a box, as "5.0 x 4.0 x 2.4 m"."""
    return " x ".join(f"{side:.1f}" for side in (bounds[1] - bounds[0]).tolist()) + " m"
