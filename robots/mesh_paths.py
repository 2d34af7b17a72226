"""Where robot files live: `package://` URIs, the example-robot-data package and the per-user cache."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import tempfile
from pathlib import Path

from robots.errors import RobotError, UrdfError


def example_robot_data() -> Path:
    """Folder `robots/` of the installed example-robot-data package; raises `RobotError` where it is absent."""
    try:
        files = importlib.metadata.files("example-robot-data") or []
    except importlib.metadata.PackageNotFoundError as error:
        raise RobotError(
            "the package example-robot-data is not installed; fix: pip install example-robot-data"
        ) from error
    for file in files:
        if file.parts[-2:] == ("example-robot-data", "package.xml"):
            return Path(str(file.locate())).resolve().parent / "robots"
    raise RobotError("example-robot-data is installed without its share folder; reinstall it")


def resolve_mesh(uri: str, urdf_path: str | Path) -> Path:
    """Absolute path of a mesh named in a URDF.

    `package://name/rest` is looked for next to the URDF and its parents, in ROS_PACKAGE_PATH, in
    AMENT_PREFIX_PATH and in example-robot-data, in this order; other paths are relative to the URDF.
    Raises `UrdfError` naming the places searched.
    """
    if uri.startswith("package://"):
        candidates = _package_candidates(uri.removeprefix("package://"), Path(urdf_path).resolve())
    else:
        candidates = [Path(urdf_path).resolve().parent / uri.removeprefix("file://")]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    places = ", ".join(str(candidate) for candidate in candidates)
    raise UrdfError(
        f"{urdf_path}: mesh {uri!r} not found; looked for {places}. Set ROS_PACKAGE_PATH to its package"
    )


def _package_candidates(name: str, urdf_path: Path) -> list[Path]:
    roots = list(urdf_path.parents)
    roots += [Path(entry) for entry in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if entry]
    roots += [Path(e) / "share" for e in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if e]
    if name.startswith("example-robot-data/"):
        roots.append(example_robot_data().parents[1])
    # A ROS package path may name the package's own folder or the one that holds it.
    package, _, rest = name.partition("/")
    return [root / name for root in roots] + [root / rest for root in roots if root.name == package]


def cache_dir() -> Path:
    """Folder for generated files: $XDG_CACHE_HOME or ~/.cache, subfolder `isdf-planning/urdf`; created."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    folder = Path(base) / "isdf-planning" / "urdf"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_cached(stem: str, suffix: str, text: str) -> Path:
    """Write a text once under a name that contains its hash, so that a stale file is never picked up."""
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = cache_dir() / f"{stem}-{digest}{suffix}"
    if not path.is_file():
        write_atomically(path, text)
    return path


def write_atomically(path: Path, text: str) -> None:
    """Write beside the target and rename, so that a reader never sees half a file."""
    with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False, encoding="utf-8") as handle:
        handle.write(text)
    # A temporary file is private by default; give it the rights a normally created file would have.
    umask = os.umask(0)
    os.umask(umask)
    os.chmod(handle.name, 0o666 & ~umask)
    os.replace(handle.name, path)
