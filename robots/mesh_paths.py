"""Where robot files live: `package://` URIs, the example-robot-data package and the per-user cache."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import os
import tempfile
from pathlib import Path

from robots.errors import RobotError, UrdfError


def example_robot_data() -> Path:
    """Folder `robots/` of the installed example-robot-data package; raises `RobotError` where it is absent."""
    manifest = installed_file("example-robot-data", "example-robot-data/package.xml", extra="robots")
    return manifest.parent / "robots"


def installed_file(package: str, ending: str, extra: str) -> Path:
    """The file of an installed package whose path ends like this.

    Raises `RobotError`, with the `extra` of this project to install, where there is no such package or file.
    """
    fix = f"fix: pip install {package}, or 'isdf-planning[{extra}]'"
    try:
        files = importlib.metadata.files(package) or []
    except importlib.metadata.PackageNotFoundError as error:
        raise RobotError(f"the package {package} is not installed; {fix}") from error
    for file in files:
        if f"/{file.as_posix()}".endswith(f"/{ending}"):
            return Path(str(file.locate())).resolve()
    raise RobotError(f"the installed package {package} has no file {ending}; {fix}")


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
        roots.append(_example_share())
    # A ROS package path may name the package's own folder or the one that holds it.
    package, _, rest = name.partition("/")
    return [root / name for root in roots] + [root / rest for root in roots if root.name == package]


@functools.cache
def _example_share() -> Path:
    """Where `package://example-robot-data` leads; asked for once a mesh, and a scan of all files of the package."""
    return example_robot_data().parents[1]


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
