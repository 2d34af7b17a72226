"""Every export by its name, and what may be chosen about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..atomic import replacing
from ..errors import ConfigError
from . import floor_plan, grid, points

Format = Literal["ply", "glb", "npz", "mha", "mhd", "pointcloud", "ros-map"]
Progress = Callable[[int, int], None]
"""Called with the work done and the whole, in any unit."""


@dataclass(frozen=True)
class ExportConfig:
    """What is exported.

    Args:
        spacing: edge of a cell of the mesh, the grid or the floor plan, and of the mesh behind a point cloud [m].
        padding: added on every side of what was observed [m].
        up: up direction of the world, for the floor plan.
        band: lowest and highest point of the robot above zero height, for the floor plan [m].
    """

    spacing: float = 0.05
    padding: float = 0.1
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    band: tuple[float, float] = (0.1, 1.5)

    def __post_init__(self) -> None:
        numbers = (self.spacing, self.padding, *self.up, *self.band)
        if not np.isfinite(numbers).all() or not self.spacing > 0 or self.padding < 0:
            raise ConfigError(
                "an export needs finite numbers, a positive spacing and no negative padding [m], got "
                f"{self.spacing} and {self.padding}"
            )
        if not np.linalg.norm(self.up) > 0:
            raise ConfigError(f"up must be a direction, got {self.up}")
        if not self.band[0] < self.band[1]:
            raise ConfigError(f"band must be a lower and a higher height [m], got {self.band}")


def export(
    field: Any,
    path: str | Path,
    format: str,
    config: ExportConfig | None = None,
    header: Mapping[str, Any] | None = None,
    progress: Progress = lambda *_: None,
) -> dict[str, Any]:
    """Write a distance field in another program's format; files appear complete or not at all.

    Args:
        field: a distance field with `bounds`, with or without `confidence`.
        path: the file to write; the image file for "mhd" and "ros-map" lies beside it.
        format: "ply" or "glb", the zero level as a mesh; "npz" or "mha" (or "mhd" + raw), distances on a grid;
            "pointcloud", the surface with normals as PLY; "ros-map", a floor plan for the ROS map_server (YAML + PGM).
        config: see `ExportConfig`.
        header: of the map file, repeated where the format has room for it.
        progress: told how far the work is.

    Returns:
        What was written: the files and their sizes in the format's own terms.

    Raises:
        ConfigError: an unknown format, or a spacing that makes too many cells.
    """
    if format not in FORMATS:
        raise ConfigError(f"no export format {format!r}; choose one of {', '.join(FORMATS)}")
    return FORMATS[format](field, Path(path), config or ExportConfig(), dict(header or {}), progress)


def _mesh(kind: str) -> Callable[..., dict[str, Any]]:
    def write(
        field: Any, path: Path, config: ExportConfig, header: dict, progress: Progress
    ) -> dict[str, Any]:
        from ..meshing import zero_level_mesh

        mesh = zero_level_mesh(field, config.spacing, padding=config.padding, up=_unit(config.up))
        if len(mesh.faces) == 0:
            raise ConfigError(f"{path}: the map holds no surface to make a mesh of")
        data = mesh.export(file_type=kind)
        assert isinstance(data, bytes)  # both kinds are binary
        with replacing(path) as temporary:
            temporary.write_bytes(data)
        return {"files": [str(path)], "vertices": len(mesh.vertices), "faces": len(mesh.faces)}

    return write


def _npz(field: Any, path: Path, config: ExportConfig, header: dict, progress: Progress) -> dict[str, Any]:
    sampled = grid.sample(field, config.spacing, config.padding, progress)
    grid.write_npz(path, sampled, header)
    return {"files": [str(path)], "shape": list(sampled.distance.shape)}


def _meta_image(suffix: str) -> Callable[..., dict[str, Any]]:
    def write(
        field: Any, path: Path, config: ExportConfig, header: dict, progress: Progress
    ) -> dict[str, Any]:
        if path.suffix != suffix:
            raise ConfigError(
                f"{path}: the reader goes by the name; call the file {path.with_suffix(suffix).name}"
            )
        sampled = grid.sample(field, config.spacing, config.padding, progress)
        files = grid.write_meta_image(path, sampled)
        return {"files": [str(file) for file in files], "shape": list(sampled.distance.shape)}

    return write


def _point_cloud(
    field: Any, path: Path, config: ExportConfig, header: dict, progress: Progress
) -> dict[str, Any]:
    count = points.write_surface_points(path, field, config.spacing, config.padding)
    return {"files": [str(path)], "points": count}


def _ros_map(
    field: Any, path: Path, config: ExportConfig, header: dict, progress: Progress
) -> dict[str, Any]:
    plan = floor_plan.draw(field, config.spacing, config.padding, _unit(config.up), config.band, progress)
    files = floor_plan.write_ros_map(path, plan)
    counts = {name: int((plan.cells == value).sum()) for name, value in floor_plan.VALUES.items()}
    return {"files": [str(file) for file in files], "shape": list(plan.cells.shape), "cells": counts}


def _unit(direction: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(direction, dtype=float) / np.linalg.norm(direction)


FORMATS: dict[Format, Callable[..., dict[str, Any]]] = {
    "ply": _mesh("ply"),
    "glb": _mesh("glb"),
    "npz": _npz,
    "mha": _meta_image(".mha"),
    "mhd": _meta_image(".mhd"),
    "pointcloud": _point_cloud,
    "ros-map": _ros_map,
}
