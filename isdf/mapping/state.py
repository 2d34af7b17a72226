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
from .lattice import BLOCK
from .mapper import Mapper

FORMAT = "isdf-lattice-map"
VERSION = 1
# Arrays of the lattice that have one entry a node.
NODES = ("value", "confidence", "block", "evidence", "share", "width")


def save(mapper: Mapper, path: Path, note: Mapping[str, Any]) -> None:
    """Write the whole state, and `note` in the header; an existing file is replaced only by a complete new one.

    Raises:
        NotReadyError: no frame has been integrated yet.
        OSError: the folder cannot be written.
    """
    bounds = mapper.bounds
    mapper.refresh()
    bricks, lattice = mapper.bricks, mapper.lattice
    arrays = {f"lattice.{name}": getattr(lattice, name) for name in NODES}
    arrays["lattice.corrections"] = lattice.corrections[: lattice.used]
    arrays["bricks.table"] = bricks.table
    # Half precision: a hundredth of the noise that is left in them.
    arrays["bricks.distance"] = bricks.distance.astype(np.float16)
    arrays["bricks.weight"] = bricks.weight.astype(np.float16)
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in arrays.items()}
    header = {
        "format": FORMAT,
        "version": VERSION,
        "config": dataclasses.asdict(mapper.config),
        "bricks_corner": bricks.corner.tolist(),
        "lattice_corner": lattice.corner.tolist(),
        "up": mapper.up.tolist(),
        "frames_seen": mapper.frames_seen,
        "frames_skipped": mapper.frames_skipped,
        "steps": mapper.steps,
        "ready": mapper._ready,
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
    bricks.restore(arrays["bricks.table"], arrays["bricks.distance"], arrays["bricks.weight"])
    for name in NODES:
        values, empty = arrays[f"lattice.{name}"], getattr(lattice, name)
        if values.dtype != empty.dtype or values.shape != arrays["lattice.value"].shape or values.ndim != 3:
            raise CheckpointError(f"{name} is {values.dtype} {values.shape}, which does not fit the lattice")
        setattr(lattice, name, values)
    corrections = arrays["lattice.corrections"]
    if (
        corrections.dtype != np.int8
        or corrections.shape[1:] != (BLOCK,)
        or lattice.block.max() >= len(corrections)
    ):
        raise CheckpointError(
            f"corrections are {corrections.dtype} {corrections.shape}, which does not fit the cells"
        )
    lattice.corrections, lattice.used = corrections, len(corrections)
    held = np.zeros(len(corrections), dtype=bool)
    held[lattice.block[lattice.block >= 0]] = True
    lattice.spare = np.flatnonzero(~held).tolist()
    mapper._bounds = tensors["bounds"].reshape(2, 3)
    mapper.up = np.array(header["up"], dtype=float).reshape(3)
    mapper.frames_seen, mapper.frames_skipped = int(header["frames_seen"]), int(header["frames_skipped"])
    mapper.steps, mapper._ready = int(header["steps"]), bool(header["ready"])
    mapper._refreshed_at = float(header["refreshed_at"] if header["refreshed_at"] is not None else -math.inf)
    mapper._guessed_at = float(header["guessed_at"] if header["guessed_at"] is not None else -math.inf)
    return mapper


def _finite(value: float) -> float | None:
    return None if math.isinf(value) else value
