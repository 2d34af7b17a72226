"""What a source of frames is, and what all live cameras share."""

from __future__ import annotations

import abc
import logging
from collections import Counter
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..camera import PinholeCamera
from ..errors import FrameError
from ..frames import DepthFrame

logger = logging.getLogger(__name__)

PoseLookup = Callable[[float], Any]
"""T_world_camera (4, 4) [m], OpenCV camera axes, at a time [s since the epoch]; None where it is not known."""


@runtime_checkable
class FrameSource(Protocol):
    """Anything that `for frame in source` takes posed depth images from.

    A recorded sequence is one, and so is a generator of `DepthFrame`s. Poses come with the frames: whoever makes a
    source says where from.
    """

    def __iter__(self) -> Iterator[DepthFrame]: ...


class LiveSource(abc.ABC):
    """A camera whose images are iterated over as they come, until `close`; use it as a context manager.

    Images that cannot be used (no pose yet, no valid pixel) are passed over; `skipped` counts them by reason. A slow
    consumer gets the newest image, not those it missed.

    Args:
        name: of the camera, for messages.
    """

    camera: PinholeCamera

    def __init__(self, name: str) -> None:
        self.name = name
        self.skipped: Counter[str] = Counter()
        self.closed = False

    @abc.abstractmethod
    def _next(self) -> DepthFrame | None:
        """The next frame, or None where the next image could not be used.

        Raises:
            SourceError: no image came for too long.
        """

    def __iter__(self) -> Iterator[DepthFrame]:
        while not self.closed:
            frame = self._next()
            if frame is not None:
                yield frame

    def close(self) -> None:
        """Stop the camera; iterating ends. Twice is once."""
        self.closed = True

    def __enter__(self) -> LiveSource:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "closed" if self.closed else "open"
        return f"<{type(self).__name__} {self.name}, {state}, {sum(self.skipped.values())} images skipped>"

    def _frame(self, depth: np.ndarray, pose: Any, time: float) -> DepthFrame | None:
        """A frame, or None with a count of why there is none."""
        if pose is None:
            self._skip("no pose")
            return None
        try:
            return DepthFrame(depth, pose, self.camera, time)
        except FrameError as error:
            logger.debug("%s: image at %.3f s passed over: %s", self.name, time, error)
            self._skip("unusable")
            return None

    def _skip(self, reason: str) -> None:
        self.skipped[reason] += 1
        if self.skipped[reason] in (1, 10, 100, 1000):
            logger.warning("%s: %d images passed over so far: %s", self.name, self.skipped[reason], reason)
