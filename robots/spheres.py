"""Collision-sphere sets: spheres per link and which link pairs may touch, in cuRobo's YAML layout."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from robots.errors import SphereFileError, UnknownLinkError
from robots.mesh_paths import write_atomically


@dataclass(frozen=True)
class SphereSet:
    """Spheres that cover a robot.

    `spheres` maps a link to rows (n, 4) of centre [m, link frame] and radius [m]; `ignored_pairs` are
    the link pairs whose contact is not a self-collision; `floor_links` drive or stand on the floor, so that
    their spheres are always near it.
    """

    spheres: Mapping[str, np.ndarray]
    ignored_pairs: frozenset[frozenset[str]] = frozenset()
    floor_links: frozenset[str] = field(default=frozenset())

    def __post_init__(self) -> None:
        for link, rows in self.spheres.items():
            if rows.ndim != 2 or rows.shape[1] != 4:
                raise SphereFileError(
                    f"spheres of {link!r} have shape {rows.shape}, expected (n, 4): x y z radius"
                )
            if not np.isfinite(rows).all() or (rows[:, 3] <= 0).any():
                raise SphereFileError(
                    f"spheres of {link!r} must be finite with radius > 0, got {rows.tolist()}"
                )

    def __len__(self) -> int:
        return sum(len(rows) for rows in self.spheres.values())

    def check_links(self, links: Collection[str]) -> None:
        """Raise `UnknownLinkError` if a sphere or a pair names a link that is not in `links`."""
        named = (
            set(self.spheres) | set(self.floor_links) | {link for pair in self.ignored_pairs for link in pair}
        )
        unknown = sorted(named - set(links))
        if unknown:
            raise UnknownLinkError(
                f"the sphere set names links {unknown} that the robot lacks; it has {list(links)}"
            )

    def restricted_to(self, links: Collection[str]) -> SphereSet:
        """The same set without links that are not in `links` (e.g. cuRobo's `attached_object`)."""
        return SphereSet(
            {link: rows for link, rows in self.spheres.items() if link in links},
            frozenset(pair for pair in self.ignored_pairs if pair <= set(links)),
            self.floor_links & set(links),
        )


def load_spheres(path: str | Path) -> SphereSet:
    """Read a sphere set from YAML.

    Accepted are cuRobo's robot files (`robot_cfg.kinematics.collision_spheres`, which may name another
    file, and `self_collision_ignore`) and bare files with `collision_spheres` at the top. Spheres with a
    negative radius, cuRobo's mark for "switched off", are skipped. Raises `SphereFileError`.
    """
    content = _read_yaml(path)
    section = content
    for key in ("robot_cfg", "kinematics"):
        section = section[key] if isinstance(section.get(key), dict) else section
    spheres = section.get("collision_spheres")
    if isinstance(spheres, str):
        spheres = _read_yaml(Path(path).parent / spheres).get("collision_spheres")
    if not isinstance(spheres, dict) or not spheres:
        raise SphereFileError(
            f"{path}: no collision_spheres mapping (link -> list of center, radius) at the top level "
            "or under robot_cfg.kinematics"
        )
    rows = {link: _rows(entries, link, path) for link, entries in spheres.items()}
    if not any(len(found) for found in rows.values()):
        raise SphereFileError(
            f"{path}: there is no sphere in it (links: {sorted(rows)}); a robot needs at least one"
        )
    ignore = section.get("self_collision_ignore") or {}
    if not isinstance(ignore, dict) or not all(isinstance(others, list) for others in ignore.values()):
        raise SphereFileError(
            f"{path}: self_collision_ignore must map a link to a list of links, got {ignore!r}"
        )
    pairs = frozenset(frozenset((a, b)) for a, others in ignore.items() for b in others)
    floor = frozenset(section.get("floor_links") or ())
    return SphereSet({link: r for link, r in rows.items() if len(r)}, pairs, floor)


def save_spheres(path: str | Path, sphere_set: SphereSet) -> None:
    """Write a sphere set in cuRobo's layout, lengths in metres rounded to 0.1 mm (radii upwards)."""
    spheres = {
        link: [
            {"center": [round(float(x), 4) for x in row[:3]], "radius": math.ceil(row[3] * 1e4 - 1e-6) / 1e4}
            for row in rows
        ]
        for link, rows in sphere_set.spheres.items()
    }
    ignore: dict[str, list[str]] = {}
    for first, second in sorted(sorted(pair) for pair in sphere_set.ignored_pairs):
        ignore.setdefault(first, []).append(second)
    kinematics: dict[str, Any] = {"collision_spheres": spheres, "self_collision_ignore": ignore}
    if sphere_set.floor_links:
        kinematics["floor_links"] = sorted(sphere_set.floor_links)
    text = yaml.safe_dump({"robot_cfg": {"kinematics": kinematics}}, sort_keys=False, default_flow_style=None)
    write_atomically(Path(path), text)


def _read_yaml(path: str | Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise SphereFileError(f"cannot read sphere file {str(path)!r}: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise SphereFileError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise SphereFileError(f"{path}: expected a YAML mapping, got {type(content).__name__}")
    return content


def _rows(entries: Any, link: str, path: str | Path) -> np.ndarray:
    rows = []
    if not isinstance(entries or [], list):
        raise SphereFileError(f"{path}: spheres of link {link!r} must be a list, got {entries!r}")
    for entry in entries or ():
        try:
            x, y, z = (float(value) for value in entry["center"])
            radius = float(entry["radius"])
        except (TypeError, KeyError, ValueError) as error:
            raise SphereFileError(
                f"{path}: sphere {entry!r} of link {link!r} is not {{center: [x, y, z], radius: r}}"
            ) from error
        if not radius < 0:
            rows.append((x, y, z, radius))
    return np.array(rows, dtype=float).reshape(-1, 4)
