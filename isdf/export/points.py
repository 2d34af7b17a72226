"""The surface as a point cloud with normals, in binary PLY."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..atomic import replacing
from ..errors import ConfigError

PROPERTIES = ("x", "y", "z", "nx", "ny", "nz")


def write_surface_points(path: Path, field: Any, spacing: float, padding: float) -> int:
    """Write the vertices of the zero level with the field's gradient there as normal; returns how many.

    Raises:
        ConfigError: the map holds no surface.
    """
    from ..meshing import zero_level_mesh

    points = np.asarray(zero_level_mesh(field, spacing, padding=padding).vertices, dtype=np.float32).reshape(
        -1, 3
    )
    if len(points) == 0:
        raise ConfigError(f"{path}: the map holds no surface to take points from")
    _, gradient = field.distance_and_gradient(torch.from_numpy(points))
    normals = torch.nn.functional.normalize(gradient, dim=-1).cpu().numpy()
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment world frame, metres",
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in PROPERTIES),
        "end_header",
    ]
    with replacing(path) as temporary:
        rows = np.hstack([points, normals]).astype("<f4")
        temporary.write_bytes(("\n".join(lines) + "\n").encode() + rows.tobytes())
    return len(points)
