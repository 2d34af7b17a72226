"""The exact ground truth of a recorded sequence as a file: the solids where they stood, and the room's box.

A JSON object with `room`, the lower and upper corner [[x, y, z], [x, y, z]] [m], and `solids`, a list of objects with
`name`, `kind` (box, cylinder or sphere), `pose` (4 x 4 rows, T_world_body [m]) and the sizes of the kind: `size` (full
edge lengths), `radius` and `height`, or `radius` [m].
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from robots.errors import SceneError
from robots.simulation.primitives import Box, Cylinder, Primitive, Sphere
from robots.simulation.scene_sdf import SceneField

SIZES: dict[str, tuple[type[Primitive], tuple[str, ...]]] = {
    "box": (Box, ("size",)),
    "cylinder": (Cylinder, ("radius", "height")),
    "sphere": (Sphere, ("radius",)),
}


@dataclass(frozen=True, eq=False)
class Truth:
    """What a sequence is compared with.

    Attributes:
        field: exact distances to the solids.
        room: lower and upper corner (2, 3) [m] of the free volume of the room.
    """

    field: SceneField
    room: Float[np.ndarray, "2 3"]


def save_truth(path: str | Path, solids: Iterable[Primitive], room: Float[np.ndarray, "2 3"]) -> None:
    """Write solids and the room's lower and upper corner [m]; `load_truth` gives the same numbers to the last bit.

    Raises:
        SceneError: if the corners are not a box.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    corners = _corners(path, np.asarray(room).tolist())
    listed = [
        {"name": solid.name, "kind": solid.kind, "pose": solid.pose.tolist()}
        | {name: _plain(getattr(solid, name)) for name in SIZES[solid.kind][1]}
        for solid in solids
    ]
    path.write_text(json.dumps({"room": corners.tolist(), "solids": listed}, indent=1) + "\n")


def load_truth(path: str | Path) -> Truth:
    """Read what `save_truth` wrote.

    Raises:
        SceneError: if the file is missing or malformed; the message names the file, the solid and the value.
    """
    path = Path(path)
    try:
        values = json.loads(path.read_text())
    except OSError as error:
        raise SceneError(
            f"{path}: no ground truth to read ({error}); record a sequence to get one"
        ) from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(values, dict) or not {"room", "solids"} <= set(values):
        raise SceneError(f"{path}: expected a JSON object with the keys room and solids")
    if not isinstance(values["solids"], list) or not values["solids"]:
        raise SceneError(f"{path}: solids must be a list with at least one solid")
    solids = [_solid(path, index, entry) for index, entry in enumerate(values["solids"])]
    names = [solid.name for solid in solids]
    if len(set(names)) < len(names):
        raise SceneError(f"{path}: names must be unique, got {max(names, key=names.count)!r} more than once")
    return Truth(SceneField(solids), _corners(path, values["room"]))


def _plain(size: Any) -> Any:
    return [float(s) for s in size] if isinstance(size, tuple) else float(size)


def _solid(path: Path, index: int, entry: Any) -> Primitive:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise SceneError(f"{path}: solid {index} must be an object with a name, got {str(entry)[:80]!r}")
    where = f"{path}: solid {entry['name']!r}"
    if entry.get("kind") not in SIZES:
        raise SceneError(f"{where}: kind must be one of {', '.join(SIZES)}, got {entry.get('kind')!r}")
    make, sizes = SIZES[entry["kind"]]
    missing = [name for name in ("pose", *sizes) if name not in entry]
    if missing:
        raise SceneError(f"{where}: a {entry['kind']} needs {', '.join(missing)}")
    pose = _numbers(where, "pose", entry["pose"], (4, 4))
    read = {name: _numbers(where, name, entry[name], (3,) if name == "size" else ()) for name in sizes}
    try:
        return make(entry["name"], pose, **{name: _as_size(value) for name, value in read.items()})
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error


def _as_size(value: np.ndarray) -> Any:
    return tuple(value.tolist()) if value.ndim else float(value)


def _corners(path: Path, room: Any) -> Float[np.ndarray, "2 3"]:
    corners = _numbers(str(path), "room", room, (2, 3))
    if not (corners[0] < corners[1]).all():
        raise SceneError(
            f"{path}: room must be its lower corner and then its upper one, got {corners.tolist()}"
        )
    return corners


def _numbers(where: str, name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        size = " x ".join(map(str, shape)) or "one"
        raise SceneError(f"{where}: {name} must be {size} finite numbers, got {str(value)[:80]}")
    return array
