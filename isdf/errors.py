"""Everything `isdf` raises on bad input derives from `IsdfError`."""

from __future__ import annotations


class IsdfError(ValueError):
    """Base of all errors raised by `isdf` for input it cannot accept."""


class CameraError(IsdfError):
    """The camera intrinsics are impossible."""


class FrameError(IsdfError):
    """A depth frame cannot be used: its shape, units, pose or pixels are wrong."""


class ConfigError(IsdfError):
    """A configuration value is outside what is accepted."""


class DatasetError(IsdfError):
    """A recorded sequence is missing files or holds something unreadable."""


class CheckpointError(IsdfError):
    """A saved map is missing, damaged, or of a version this release cannot read."""


class DivergedError(IsdfError):
    """Training has left the numbers: the loss is NaN or infinite."""


class NotReadyError(IsdfError):
    """The map was asked for something it can only give after a first frame."""


class BackgroundError(IsdfError):
    """The background mapper has failed, by the error this one was raised from, or is closed."""


class EvaluationError(IsdfError):
    """A map cannot be judged: its answers are not numbers, or there is nothing to judge it by."""


class SourceError(IsdfError):
    """A live camera cannot be opened, or its images have stopped coming."""


class ViewerError(IsdfError):
    """The viewer cannot be opened, or a recording cannot be read."""
