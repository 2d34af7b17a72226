"""The commands of `isdf` that read a map file: query, export and info."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from . import mapfile
from .atomic import replacing
from .errors import IsdfError
from .export import ExportConfig, export
from .export.formats import Format
from .field import query
from .methods import load_map

MAP_FILE = "map.safetensors"
# Points answered at once: between two of them the progress bar moves.
QUERY_POINTS = 1 << 17


@dataclass(frozen=True)
class Outcome:
    """What a command did: a sentence for people, and the same for machines.

    Args:
        text: for people.
        data: anything that JSON can hold.
    """

    text: str
    data: dict[str, Any]


def map_file(path: Path) -> Path:
    """The map in a folder that `isdf map` wrote, or the file itself."""
    return path / MAP_FILE if path.is_dir() else path


@dataclass(frozen=True)
class Query:
    """Ask a saved map for distances and gradients at any world points."""

    map: tyro.conf.Positional[Path]
    """Folder that `isdf map` wrote, or a map file."""
    points: Path
    """A .npy file with an (N, 3) array of world points [m]."""
    out: Path
    """The .npz file to write: distance (N,) [m], gradient (N, 3), and confidence (N,) where the field has one."""
    json: bool = False
    """Print the outcome as one line of JSON."""

    def run(self) -> Outcome:
        """Load, query, write."""
        field = load_map(map_file(self.map)).field()
        try:
            with self.points.open("rb") as file:
                points = np.lib.format.read_array(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise IsdfError(
                f"{self.points}: not a readable .npy array ({error}); numpy.save writes one of (N, 3) points"
            ) from error
        if points.ndim != 2:
            raise IsdfError(f"{self.points}: points must be one (N, 3) array, got the shape {points.shape}")
        blocks = np.array_split(points, max(1, len(points) // QUERY_POINTS))
        parts = [query(field, block) for block in tqdm(blocks, desc="querying", disable=None)]
        answers = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        with replacing(self.out) as temporary, temporary.open("wb") as file:
            np.savez(file, **answers)  # type: ignore[arg-type]
        return Outcome(
            f"{len(points)} points: {', '.join(answers)} in {self.out}",
            {"points": len(points), "arrays": list(answers), "file": str(self.out)},
        )


@dataclass(frozen=True)
class Export:
    """Write a saved map for other programs: mesh, points, grid or floor plan."""

    map: tyro.conf.Positional[Path]
    """Folder that `isdf map` wrote, or a map file."""
    format: Format
    """ply, glb: the surface as a mesh. pointcloud: the surface as points with normals (PLY). npz, mha, mhd: distances
    on a grid, for numpy or as MetaImage (ITK, VTK, ParaView). ros-map: the floor plan that the ROS map_server reads
    (YAML and PGM): occupied, free where every height of --band was seen, unknown elsewhere."""
    out: Path
    """The file to write."""
    config: tyro.conf.OmitArgPrefixes[ExportConfig] = ExportConfig()  # noqa: RUF009
    """What is exported."""
    json: bool = False
    """Print the outcome as one line of JSON."""

    def run(self) -> Outcome:
        """Load, then write in the format asked for."""
        path = map_file(self.map)
        header = mapfile.header(path)
        field = load_map(path).field()
        with tqdm(desc="exporting", disable=None, leave=False) as bar:

            def progress(done: int, whole: int) -> None:
                bar.total = whole
                bar.update(done - bar.n)

            written = export(field, self.out, self.format, self.config, header, progress)
        rest = ", ".join(f"{name} {value}" for name, value in written.items() if name != "files")
        return Outcome(f"{', '.join(written['files'])}: {rest}", {"format": self.format} | written)


@dataclass(frozen=True)
class Info:
    """Tell what a map file says about itself: method, bounds, provenance."""

    map: tyro.conf.Positional[Path]
    """Folder that `isdf map` wrote, or a map file."""
    json: bool = False
    """Print everything as one line of JSON."""

    def run(self) -> Outcome:
        """Read the header; the numbers themselves are left alone."""
        path = map_file(self.map)
        header = mapfile.header(path)
        size = path.stat().st_size
        shown = {"file": str(path), "bytes": size} | {k: v for k, v in header.items() if k != "tensors"}
        lines = [
            f"{name}: {value if isinstance(value, str) else _short(value)}" for name, value in shown.items()
        ]
        lines.append(f"tensors: {len(header['tensors'])}")
        return Outcome("\n".join(lines), shown | {"tensors": header["tensors"]})


def _short(value: Any, limit: int = 400) -> str:
    text = json.dumps(value)
    return text if len(text) <= limit else f"{text[:limit]}... (all of it with --json)"
