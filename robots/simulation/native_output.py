"""What C++ code prints: pybullet's importer writes a page of warnings for a URDF without masses."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def logged_instead(logger: logging.Logger) -> Iterator[None]:
    """Send all that is printed meanwhile, also by compiled code, to a logger at debug level.

    Other threads that print meanwhile are caught, too.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [os.dup(fd) for fd in (1, 2)]
    with tempfile.TemporaryFile() as file:
        try:
            for fd in (1, 2):
                os.dup2(file.fileno(), fd)
            yield
        finally:
            for fd, old in zip((1, 2), saved, strict=True):
                os.dup2(old, fd)
                os.close(old)
            file.seek(0)
            if text := file.read().decode(errors="replace").strip():
                logger.debug("%s", text)
