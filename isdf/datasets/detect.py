"""Which layout a recorded sequence has."""

from __future__ import annotations

from pathlib import Path

from ..errors import DatasetError
from .polycam import PolycamSequence
from .recorded import RecordedSequence
from .replica import ReplicaCadSequence, ReplicaSequence
from .rosbag import RosbagSequence
from .scannet import ScanNetSequence
from .sequence import DepthSequence
from .seven_scenes import SevenScenesSequence
from .tum import TumSequence

LAYOUTS = (
    RecordedSequence,
    ReplicaCadSequence,  # before Replica, whose cam_params.json may lie in the folder above both
    ReplicaSequence,
    ScanNetSequence,
    SevenScenesSequence,
    TumSequence,
    PolycamSequence,
    RosbagSequence,
)


def open_sequence(path: str | Path, fps: float | None = None) -> DepthSequence:
    """The depth sequence in a folder or bag file, whichever known layout it has.

    Args:
        path: a sequence's folder, or a ROS bag.
        fps: frames a second; by default what the sequence says, else 30.

    Raises:
        DatasetError: it has none of the layouts (the message says what each misses), or a file of it is broken.
    """
    path = Path(path)
    if not path.exists():
        raise DatasetError(f"{path}: not a recorded sequence, there is no such file or folder")
    misses = {}
    for layout in LAYOUTS:
        misses[layout.layout] = layout.missing(path)
        if not misses[layout.layout]:
            return layout(path, fps=fps)
    tried = "; ".join(f"{name}: {', '.join(missing)}" for name, missing in misses.items())
    raise DatasetError(f"{path}: not a recorded sequence of any known layout. Missing for each: {tried}")
