"""The default map as a file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import CheckpointError
from ..mapfile import consistent, read, write
from .config import MapperConfig
from .distortion import Key
from .lattice import BLOCK, CHUNK, NODES
from .mapper import Mapper

FORMAT = "isdf-lattice-map"
VERSION = 6


def save(mapper: Mapper, path: Path, note: Mapping[str, Any]) -> None:
    """Write the whole state, and `note` in the header; an existing file is replaced only by a complete new one.

    Raises:
        NotReadyError: no frame has been integrated yet.
        OSError: the folder cannot be written.
    """
    bounds = mapper.bounds
    mapper.refresh()
    bricks, lattice = mapper.bricks, mapper.lattice
    held = lattice.table >= 0
    arrays = {f"lattice.{name}": lattice.nodes.arrays[name][lattice.table[held]] for name in NODES}
    arrays["lattice.table"] = _numbered(lattice.table, held)
    block = arrays["lattice.block"]
    arrays["lattice.corrections"] = lattice.corrections[block[block >= 0]]
    arrays["lattice.block"] = _numbered(block, block >= 0)
    arrays["bricks.table"] = bricks.table
    # Half precision: a hundredth of the noise that is left in them.
    arrays["bricks.distance"] = bricks.distance.astype(np.float16)
    arrays["bricks.weight"] = bricks.weight.astype(np.float16)
    arrays["bricks.ended"] = bricks.ended.astype(np.float16)
    arrays["distortion.information"] = mapper.distortion.information
    arrays["distortion.vector"] = mapper.distortion.vector
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in arrays.items()}
    header = {
        "format": FORMAT,
        "version": VERSION,
        "config": dataclasses.asdict(mapper.config),
        "bricks_corner": bricks.corner.tolist(),
        "lattice_corner": lattice.corner.tolist(),
        "up": mapper.up.tolist(),
        "camera": mapper.distortion.key,
        "frames_seen": mapper.frames_seen,
        "frames_skipped": mapper.frames_skipped,
        "steps": mapper.steps,
        "ready": mapper._ready,
        "fused_at": _finite(mapper._fused_at),
        "refreshed_at": _finite(mapper._refreshed_at),
        "guessed_at": _finite(mapper._guessed_at),
    }
    write(path, tensors | {"bounds": bounds}, {**note, **header})


def load(path: Path, device: str | torch.device = "cpu") -> Mapper:
    """Read a map written by `save`.

    Raises:
        CheckpointError: the file is missing, damaged, of another kind or of another version.
    """
    tensors, header = read(path, FORMAT, VERSION)
    with consistent(path):
        return _restored(tensors, header, device)


def _restored(tensors: dict[str, Tensor], header: dict[str, Any], device: str | torch.device) -> Mapper:
    mapper = Mapper(MapperConfig(**header["config"]), device)
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    bricks, lattice = mapper.bricks, mapper.lattice
    bricks.corner = np.array(header["bricks_corner"], dtype=np.int64).reshape(3)
    lattice.corner = np.array(header["lattice_corner"], dtype=np.int64).reshape(3)
    bricks.restore(*(arrays[f"bricks.{name}"] for name in ("table", "distance", "weight", "ended")))
    nodes = {name: arrays[f"lattice.{name}"] for name in NODES}
    lattice.table = arrays["lattice.table"]
    corrections, rows = arrays["lattice.corrections"], len(nodes["value"])
    for name, values in nodes.items():
        if values.dtype != NODES[name][0] or values.shape != (rows, CHUNK**3):
            raise CheckpointError(f"{name} is {values.dtype} {values.shape}, which does not fit the lattice")
    _check_numbers("chunks", lattice.table, 3, rows)
    if corrections.dtype != np.int8 or corrections.shape[1:] != (BLOCK,):
        raise CheckpointError(f"corrections are {corrections.dtype} {corrections.shape}, not those of cells")
    _check_numbers("cells", nodes["block"], 2, len(corrections))
    lattice.nodes.restore(nodes)
    lattice.cells.restore({"corrections": corrections})
    key = header["camera"]
    mapper.distortion.restore(
        Key(tuple(key[0]), tuple(key[1])) if key else None,
        arrays["distortion.information"],
        arrays["distortion.vector"],
    )
    mapper._bounds = tensors["bounds"].reshape(2, 3)
    mapper.up = np.array(header["up"], dtype=float).reshape(3)
    mapper.frames_seen, mapper.frames_skipped = int(header["frames_seen"]), int(header["frames_skipped"])
    mapper.steps, mapper._ready = int(header["steps"]), bool(header["ready"])
    mapper._fused_at = float(header["fused_at"] if header["fused_at"] is not None else -math.inf)
    mapper._refreshed_at = float(header["refreshed_at"] if header["refreshed_at"] is not None else -math.inf)
    mapper._guessed_at = float(header["guessed_at"] if header["guessed_at"] is not None else -math.inf)
    return mapper


def _numbered(rows: np.ndarray, held: np.ndarray) -> np.ndarray:
    """The same table for rows in the order in which the table names them."""
    out = np.full(rows.shape, -1, dtype=np.int32)
    out[held] = np.arange(held.sum())
    return out


def _check_numbers(what: str, table: np.ndarray, axes: int, rows: int) -> None:
    """Refuse a table that does not name each of so many rows once: two would be written as one."""
    named = np.sort(table[table >= 0])
    if table.dtype != np.int32 or table.ndim != axes or not np.array_equal(named, np.arange(rows)):
        raise CheckpointError(
            f"the table of {what} is {table.dtype} {table.shape} and does not fit {rows} of them"
        )


def _finite(value: float) -> float | None:
    return None if math.isinf(value) else value
