"""Distances on a regular grid, for numpy and for programs that read MetaImage (ITK, VTK, ParaView, 3D Slicer)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from ..atomic import replacing
from ..errors import ConfigError
from ..field import grid_points

# Most cells of a grid: 240 MB of distances and as much confidence.
MAX_CELLS = 60_000_000


class SampledGrid(NamedTuple):
    """A field at grid points.

    Args:
        distance: (nx, ny, nz) signed distances [m].
        confidence: of the same shape, where the field has one.
        origin: (3,) world position of element [0, 0, 0] [m].
        spacing: distance of grid points [m].
    """

    distance: Float[np.ndarray, "nx ny nz"]
    confidence: Float[np.ndarray, "nx ny nz"] | None
    origin: Float[np.ndarray, "3"]
    spacing: float


def sample(field: Any, spacing: float, padding: float, progress: Callable[[int, int], None]) -> SampledGrid:
    """Ask a field for its distance and confidence on a grid over its bounds grown by `padding` [m].

    Plane by plane, so that the points of the whole grid are never in memory.

    Raises:
        ConfigError: there would be more than 60 million cells.
    """
    region = field.bounds.double().cpu() + padding * torch.tensor([[-1.0], [1.0]])
    sides = torch.ceil((region[1] - region[0]) / spacing)
    cells = float(torch.prod(sides + 1))
    if not cells <= MAX_CELLS:
        raise ConfigError(
            f"a grid at {spacing} m over {[round(float(s * spacing), 1) for s in sides]} m takes {cells:.2g} cells "
            f"(at most {MAX_CELLS:.1g}); choose a spacing of {spacing * (cells / MAX_CELLS) ** (1 / 3):.3f} m or more"
        )
    plane = grid_points(
        torch.stack([region[0], torch.cat([region[0, :1] + spacing, region[1, 1:]])]), spacing
    )[0]
    planes = int(sides[0]) + 1
    distance = np.empty((planes, *plane.shape[:2]), dtype=np.float32)
    confidence = np.empty_like(distance) if hasattr(field, "confidence") else None
    for i in range(planes):
        points = (plane + torch.tensor([i * spacing, 0.0, 0.0], dtype=plane.dtype)).float()
        distance[i] = field.distance(points).cpu().numpy()
        if confidence is not None:
            confidence[i] = field.confidence(points).cpu().numpy()
        progress(i + 1, planes)
    return SampledGrid(distance, confidence, region[0].numpy(), spacing)


def write_npz(path: Path, grid: SampledGrid, header: dict[str, Any]) -> None:
    """`distance`, `confidence` where there is one, `origin`, `spacing`, and `header`, the map's header as JSON."""
    arrays: dict[str, Any] = {"distance": grid.distance, "origin": grid.origin, "spacing": grid.spacing}
    if grid.confidence is not None:
        arrays["confidence"] = grid.confidence
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, header=json.dumps(header), **arrays)


def write_meta_image(path: Path, grid: SampledGrid) -> list[Path]:
    """The distances as one .mha file, or as .mhd with a .raw beside it, by the suffix; returns the files."""
    raw = path.with_suffix(".raw") if path.suffix == ".mhd" else None
    sizes = " ".join(str(n) for n in grid.distance.shape)
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = False",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        f"Offset = {' '.join(repr(float(x)) for x in grid.origin)}",
        f"ElementSpacing = {grid.spacing} {grid.spacing} {grid.spacing}",
        f"DimSize = {sizes}",
        "ElementType = MET_FLOAT",
        f"ElementDataFile = {raw.name if raw else 'LOCAL'}",  # the format wants it last
    ]
    front = ("\n".join(lines) + "\n").encode()
    values = np.ascontiguousarray(grid.distance.T, dtype="<f4").tobytes()  # x varies fastest
    if raw is None:
        with replacing(path) as temporary:
            temporary.write_bytes(front + values)
        return [path]
    with replacing(raw) as temporary:
        temporary.write_bytes(values)
    with replacing(path) as temporary:
        temporary.write_bytes(front)
    return [path, raw]
