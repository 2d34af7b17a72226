"""Map files: safetensors for the numbers and a JSON header for the rest; written atomically, read with suspicion.

The header states `format` and `version` (of the method's state), `file_version` (of the container), `units`, `frame`,
`bounds`, and where the map comes from: `package`, `created` and what the caller adds. There is no pickle, so a file
cannot run code. Every size is compared with the file's before memory is taken, so a file cannot claim more memory
than it has bytes; a checksum over header and tensors finds damage.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import math
import struct
import zlib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as from_bytes
from safetensors.torch import save as to_bytes

from .atomic import replacing
from .errors import CheckpointError

FILE_VERSION = 1
# Longest header [bytes]. One of a map of an hour has some hundred kilobytes.
MAX_HEADER = 16 << 20
# Largest file that is read [bytes]: the voxel maps' own limit on voxels lies below it.
MAX_FILE = 4 << 30
# Bytes an element of the tensors that maps are made of.
ITEM_SIZE = {"F64": 8, "F32": 4, "F16": 2, "I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}
WORLD = "right-handed, as the camera poses were given; cameras look along z, x right, y down"


def write(path: Path, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
    """Write tensors and a JSON header to one file; an existing file is replaced only by a complete new one.

    Args:
        path: the file; its folder is made if missing.
        tensors: on any device; `bounds` (2, 3) [m] is repeated in the header.
        header: with `format` and `version`; units, frame and provenance are added.
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    bounds = tensors["bounds"].tolist() if "bounds" in tensors else None
    stated = {
        "file_version": FILE_VERSION,
        "units": "metres",
        "frame": WORLD,
        "bounds": bounds,
        "package": {"name": "isdf-planning", "version": package_version()},
        "created": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="milliseconds"),
    }
    text = json.dumps(header | stated)
    data = to_bytes(tensors, metadata={"isdf": text, "checksum": _checksum(text, tensors)})
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def header(path: Path) -> dict[str, Any]:
    """The header of a map file of any method, and `tensors`: the type and shape of each.

    Raises:
        CheckpointError: the file is missing, damaged, no map, or of a newer file version.
    """
    return _checked_header(path, _read_front(path))


def kind(path: Path) -> str:
    """The `format` that the header of a map file names.

    Raises:
        CheckpointError: as `header`.
    """
    return header(path)["format"]


def read(path: Path, expected: str, version: int) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and header of a map file of the expected format and version.

    Raises:
        CheckpointError: the file is missing, damaged, of another kind or of another version.
    """
    found = header(path)
    if found["format"] != expected:
        raise CheckpointError(
            f"{path}: a map of format {found['format']!r}, not {expected!r}; isdf.load_map(path) reads every kind"
        )
    if found.get("version") != version:
        raise CheckpointError(_other_version(path, "map format version", found.get("version"), version))
    stated = _read_front(path)["__metadata__"]
    try:
        tensors = from_bytes(path.read_bytes())
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        raise CheckpointError(f"{path}: not a readable map ({error})") from error
    if _checksum(stated["isdf"], tensors) != stated.get("checksum"):
        raise CheckpointError(f"{path}: damaged, it does not match its checksum; map again or restore a copy")
    return tensors, found


@contextlib.contextmanager
def consistent(path: Path) -> Iterator[None]:
    """Turn what goes wrong while a mapper is built from a file into a CheckpointError that names the file."""
    try:
        yield
    except (LookupError, TypeError, ValueError, ArithmeticError, RuntimeError, AttributeError) as error:
        raise CheckpointError(
            f"{path}: the map is incomplete or inconsistent ({error}); map again"
        ) from error


def require_finite(tensors: dict[str, torch.Tensor]) -> None:
    """Refuse tensors of floating-point numbers that hold NaN or inf; the message names the first."""
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise CheckpointError(f"{name} holds NaN or inf")


def package_version() -> str:
    """Version of this package, "unknown" where it runs without having been installed."""
    try:
        return metadata.version("isdf-planning")
    except metadata.PackageNotFoundError:
        return "unknown"


def _read_front(path: Path) -> dict[str, Any]:
    """The safetensors header, with every claim in it compared with the size of the file."""
    if not path.is_file():
        raise CheckpointError(
            f"{path}: no such file; a map is written by mapper.save(path) or `isdf map --out`"
        )
    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            if length > min(MAX_HEADER, size - 8):
                raise ValueError(f"a header of {length} bytes in a file of {size}, at most {MAX_HEADER}")
            if size > MAX_FILE:
                raise ValueError(f"{size} bytes, at most {MAX_FILE} are read")
            front = json.loads(file.read(length))
        if not isinstance(front, dict):
            raise ValueError("its header is no JSON object")
        _check_sizes(front, size - 8 - length)
    except (OSError, struct.error, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: not a readable map ({error})") from error
    return front


def _check_sizes(front: dict[str, Any], available: int) -> None:
    shape: Any
    dtype: Any
    total = 0
    for name, entry in front.items():
        if name == "__metadata__":
            continue
        if not isinstance(entry, dict):
            raise ValueError(f"tensor {name!r} is not described")
        shape, dtype = entry.get("shape"), entry.get("dtype")
        described = isinstance(shape, list) and isinstance(dtype, str) and dtype in ITEM_SIZE
        if not described or not all(type(n) is int and 0 <= n <= MAX_FILE for n in shape):
            raise ValueError(f"tensor {name!r} has type {dtype!r} and shape {shape!r}"[:200])
        total += math.prod(shape) * ITEM_SIZE[dtype]
    if total != available:
        raise ValueError(f"tensors of {total} bytes are described, {available} are there"[:200])


def _checked_header(path: Path, front: dict[str, Any]) -> dict[str, Any]:
    described = front.get("__metadata__")
    text = described.get("isdf") if isinstance(described, dict) else None
    try:
        found = json.loads(text) if isinstance(text, str) else None
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: not a readable map ({error})") from error
    if not isinstance(found, dict) or not isinstance(found.get("format"), str):
        raise CheckpointError(f"{path}: a safetensors file, but not a map written by this package")
    version = found.get("file_version")
    if type(version) is not int or not 1 <= version <= FILE_VERSION:
        raise CheckpointError(_other_version(path, "map file version", version, FILE_VERSION))
    described = {name: entry for name, entry in front.items() if name != "__metadata__"}
    return found | {"tensors": {n: {"dtype": e["dtype"], "shape": e["shape"]} for n, e in described.items()}}


def _other_version(path: Path, what: str, found: Any, known: int) -> str:
    """What to do about a file of another version."""
    if type(found) is not int:
        return f"{path}: {what} {found!r} is no version number; map again or restore a copy"
    if found > known:
        return f"{path}: {what} {found} is newer than the {known} that this release reads; update the package"
    return f"{path}: {what} {found} is older than the {known} that this release reads; map again"


def _checksum(text: str, tensors: dict[str, torch.Tensor]) -> str:
    crc = zlib.crc32(text.encode())
    for name in sorted(tensors):
        value = tensors[name]
        crc = zlib.crc32(f"{name} {value.dtype} {tuple(value.shape)}".encode(), crc)
        crc = zlib.crc32(value.reshape(-1).view(torch.uint8).numpy().data if value.numel() else b"", crc)
    return f"{crc:08x}"
