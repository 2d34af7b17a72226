"""What drives a robot's fingers."""

from __future__ import annotations

from dataclasses import dataclass

from robots.errors import RobotError


@dataclass(frozen=True)
class Gripper:
    """A gripper driven by some joints: their values open and closed [rad | m], and the grip force [N]."""

    joint_names: tuple[str, ...]
    open_position: tuple[float, ...]
    closed_position: tuple[float, ...]
    max_force: float

    def __post_init__(self) -> None:
        sizes = {len(self.joint_names), len(self.open_position), len(self.closed_position)}
        if len(sizes) != 1:
            raise RobotError(f"a gripper needs one open and one closed position a joint: {self}")
