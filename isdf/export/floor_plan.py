"""What a robot of some height may drive over, as the occupancy map that the ROS map_server reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8

from ..atomic import replacing
from ..errors import ConfigError
from ..slice_geometry import corners, slice_basis

# Grey values of map_server's trinary mode; they fall on the right side of the thresholds below.
VALUES = {"occupied": 0, "unknown": 205, "free": 254}
OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.196
# From this confidence on a place counts as seen.
KNOWN = 0.5
MAX_CELLS = 20_000_000


class FloorPlan(NamedTuple):
    """Occupied, unknown and free cells.

    Args:
        cells: (rows, columns) of `VALUES`; row 0 has the greatest y, as in an image.
        spacing: edge of a cell [m].
        origin: (2,) lower left corner of the plan along the two horizontal directions [m].
        basis: (3, 3) rows are the plan's x, y and up direction in the world.
    """

    cells: UInt8[np.ndarray, "rows columns"]
    spacing: float
    origin: Float[np.ndarray, "2"]
    basis: Float[np.ndarray, "3 3"]


def draw(
    field: Any,
    spacing: float,
    padding: float,
    up: Float[np.ndarray, "3"],
    band: tuple[float, float],
    progress: Callable[[int, int], None],
) -> FloorPlan:
    """Look at every cell at heights `spacing` apart within the band.

    A cell is occupied where the surface is nearer than half its diagonal, or behind, at any height; free where it is
    not and every height was seen; unknown otherwise. A field without `confidence` counts as seen within its bounds.

    Args:
        field: a distance field with `bounds`.
        spacing: edge of a cell [m].
        padding: added around what was observed [m]: walls may lie on its very edge.
        up: unit vector.
        band: lowest and highest height [m] along `up`.
        progress: told how many heights of all are done.

    Raises:
        ConfigError: there would be more than 20 million cells.
    """
    basis = slice_basis(up)
    along = corners(field.bounds.cpu().numpy()) @ basis.T
    low, high = along.min(axis=0)[:2] - padding, along.max(axis=0)[:2] + padding
    columns, rows = np.ceil((high - low) / spacing)
    heights = np.linspace(*band, int(min(np.ceil((band[1] - band[0]) / spacing), MAX_CELLS)) + 1)
    if not rows * columns * len(heights) <= 60 * MAX_CELLS or not rows * columns <= MAX_CELLS:
        raise ConfigError(
            f"a floor plan of {rows:.3g} x {columns:.3g} cells is too large; choose a larger spacing"
        )
    x = low[0] + spacing * (np.arange(int(columns)) + 0.5)
    y = low[1] + spacing * (np.arange(int(rows))[::-1] + 0.5)
    plane = np.stack([*np.meshgrid(x, y), np.zeros((int(rows), int(columns)))], axis=-1)
    occupied = np.zeros(plane.shape[:2], dtype=bool)
    seen = np.ones_like(occupied)
    for number, height in enumerate(heights):
        points = torch.from_numpy((plane @ basis + height * basis[2]).astype(np.float32))
        known = _known(field, points)
        occupied |= known & (field.distance(points).cpu().numpy() < spacing / np.sqrt(2))
        seen &= known
        progress(number + 1, len(heights))
    cells = np.where(occupied, VALUES["occupied"], np.where(seen, VALUES["free"], VALUES["unknown"]))
    return FloorPlan(cells.astype(np.uint8), spacing, low, basis)


def _known(field: Any, points: torch.Tensor) -> np.ndarray:
    if hasattr(field, "confidence"):
        return (field.confidence(points) >= KNOWN).cpu().numpy()
    bounds = field.bounds.to(points)
    return ((points >= bounds[0]) & (points <= bounds[1])).all(dim=-1).cpu().numpy()


def write_ros_map(path: Path, plan: FloorPlan) -> list[Path]:
    """Write `path` (YAML) and a PGM image beside it; returns both files."""
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{path}: map_server reads a YAML file; call it {path.with_suffix('.yaml').name}")
    image = path.with_suffix(".pgm")
    rows, columns = plan.cells.shape
    directions = "; ".join(
        f"{name} = {' '.join(f'{v:.4f}' for v in row)}" for name, row in zip("xyz", plan.basis, strict=True)
    )
    text = (
        f"# The plan's axes in the map's world frame: {directions}\n"
        f"image: {image.name}\n"
        f"mode: trinary\n"
        f"resolution: {plan.spacing}\n"
        f"origin: [{plan.origin[0]:.6f}, {plan.origin[1]:.6f}, 0.0]\n"
        f"negate: 0\n"
        f"occupied_thresh: {OCCUPIED_ABOVE}\n"
        f"free_thresh: {FREE_BELOW}\n"
    )
    with replacing(image) as temporary:
        temporary.write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + plan.cells.tobytes())
    with replacing(path) as temporary:
        temporary.write_text(text)
    return [path, image]
