"""Recorded depth sequences: reading and writing."""

from .recorded import RecordedSequence, SequenceWriter

__all__ = ["RecordedSequence", "SequenceWriter"]
