"""Files that are replaced only by complete new ones, whatever happens while they are written."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` to write; it takes the name of `path` when the block ends without an error.

    The new file is on the disk before it gets the name, so that neither a killed process nor a power cut leaves half
    a file. A process killed meanwhile leaves the temporary file behind; `sweep` removes it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def sweep(path: Path) -> None:
    """Remove what killed processes left behind while they wrote `path`."""
    for left in path.parent.glob(f".{path.name}.*"):
        left.unlink(missing_ok=True)


def _umask() -> int:
    # There is no way to read it without setting it; mkstemp's own 0600 would hide results from other users.
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
