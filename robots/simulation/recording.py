"""What happened in a world, step by step: enough to replay an episode and to count its true contacts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from robots.simulation.contacts import Contact
from robots.simulation.world import World


class Recording:
    """States of a world with a robot, one for every call of `add`.

    Args:
        world: with its robot.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.contacts: list[tuple[float, Contact]] = []
        """Time [s] and contact of every robot link with every body, of all steps."""
        self._times: list[float] = []
        self._postures: list[np.ndarray] = []
        self._movable = [name for name, solid in world.solids.items() if solid.mass > 0]
        self._poses: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._times)

    def add(self) -> None:
        """Record where everything is now, and what touched since the last step of physics."""
        self._times.append(self.world.time)
        self._postures.append(self.world.robot_state()[0])
        self._poses.append(np.array([self.world.object_pose(n) for n in self._movable]).reshape(-1, 4, 4))
        self.contacts += [(self.world.time, contact) for contact in self.world.contacts()]

    def base_poses(self) -> Float[np.ndarray, "n 3"]:
        """Where a mobile base was, (x, y, yaw) [m, m, rad]: the first three joints of every posture."""
        return np.array([posture[:3] for posture in self._postures]).reshape(-1, 3)

    def touched(self, ignore: tuple[str, ...] = ()) -> dict[str, float]:
        """Deepest penetration [m] of each pair "link - body" that touched, but for the named bodies."""
        deepest: dict[str, float] = {}
        for _, contact in self.contacts:
            if contact.body not in ignore:
                pair = f"{contact.link} - {contact.body}"
                deepest[pair] = max(deepest.get(pair, 0.0), float(contact.depth))
        return deepest

    def save(self, path: str | Path) -> None:
        """Write the states to an .npz file.

        It holds time (n,) [s], joint_names, joint_positions (n, dof), object_names, object_poses (n, k, 4, 4) [m],
        and base_pose (n, 3) [m, m, rad] where the robot has a base.
        """
        names = self.world.robot.joint_names
        postures = np.array(self._postures).reshape(len(self), len(names))
        arrays = {
            "time": np.array(self._times),
            "joint_names": np.array(names),
            "joint_positions": postures,
            "object_names": np.array(self._movable),
            "object_poses": np.array(self._poses).reshape(len(self), len(self._movable), 4, 4),
        }
        if names[:3] == ("base_x", "base_y", "base_yaw"):
            arrays["base_pose"] = postures[:, :3]
        np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
