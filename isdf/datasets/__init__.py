"""Depth sequences: a recorded folder to read and write, and readers of the layouts that public data comes in."""

from .detect import open_sequence
from .polycam import PolycamSequence
from .recorded import RecordedSequence, SequenceWriter
from .replica import ReplicaCadSequence, ReplicaSequence
from .rosbag import RosbagSequence
from .scannet import ScanNetSequence
from .sequence import DepthSequence
from .seven_scenes import SevenScenesSequence
from .tum import TumSequence

__all__ = [
    "DepthSequence",
    "PolycamSequence",
    "RecordedSequence",
    "ReplicaCadSequence",
    "ReplicaSequence",
    "RosbagSequence",
    "ScanNetSequence",
    "SequenceWriter",
    "SevenScenesSequence",
    "TumSequence",
    "open_sequence",
]
