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
        self._heads: list[list[float]] = []
        self._at_start = world.solids
        self._movers = {name: None for name, solid in self._at_start.items() if solid.mass > 0}
        self._poses: list[dict[str, np.ndarray]] = []

    def __len__(self) -> int:
        return len(self._times)

    def add(self) -> None:
        """Record where everything is now, and what touched since the last step of physics."""
        self._times.append(self.world.time)
        self._postures.append(self.world.robot_state()[0])
        robot = self.world.robot
        self._heads.append([robot.joint_position(name) for name in robot.head_joints])
        solids = self.world.solids
        # The world replaces a static solid that is put elsewhere.
        self._movers |= {
            name: None for name, solid in solids.items() if solid is not self._at_start.get(name)
        }
        self._poses.append({name: self.world.object_pose(name) for name in self._movers if name in solids})
        self.contacts += [(self.world.time, contact) for contact in self.world.contacts()]

    def base_poses(self) -> Float[np.ndarray, "n 3"]:
        """Where a mobile base was, (x, y, yaw) [m, m, rad]: the first three joints of every posture."""
        return np.array([posture[:3] for posture in self._postures]).reshape(-1, 3)

    def postures(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n dof"]]:
        """Times [s] and joint positions of every state, in the order of the robot's `joint_names`."""
        return np.array(self._times), np.array(self._postures).reshape(
            len(self), len(self.world.robot.joint_names)
        )

    def heights(self, name: str) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Times [s], and how high [m] the origin of a body with a mass was then."""
        found = [
            (t, state[name][2, 3]) for t, state in zip(self._times, self._poses, strict=True) if name in state
        ]
        return np.array([t for t, _ in found]), np.array([z for _, z in found])

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

        It holds time (n,) [s], joint_names, joint_positions (n, dof), object_names, object_poses (n, k, 4, 4) [m];
        base_pose (n, 3) [m, m, rad] where the robot has a base; and where it has a head head_joints and head_positions
        (n, 2) [rad], with which `robots.Robot.camera_pose` tells where the camera was. Objects are the solids with a
        mass and those that were moved or added, NaN while they are not in the world.
        """
        names = self.world.robot.joint_names
        times, postures = self.postures()
        arrays = {
            "time": times,
            "joint_names": np.array(names),
            "joint_positions": postures,
            "object_names": np.array(self.movers, dtype=str),
            "object_poses": self.object_poses(),
        }
        if names[:3] == ("base_x", "base_y", "base_yaw"):
            arrays["base_pose"] = postures[:, :3]
        if head := self.world.robot.head_joints:
            arrays |= {
                "head_joints": np.array(head),
                "head_positions": np.array(self._heads).reshape(-1, len(head)),
            }
        np.savez_compressed(path, **arrays)  # type: ignore[arg-type]

    @property
    def movers(self) -> tuple[str, ...]:
        """Names of the solids with a mass and of those that were moved or added."""
        return tuple(self._movers)

    def object_poses(self) -> Float[np.ndarray, "n k 4 4"]:
        """Poses [m] of the `movers` at every state, NaN while one is not in the world."""
        poses = np.full((len(self), len(self._movers), 4, 4), np.nan)
        for k, name in enumerate(self._movers):
            if name in self._at_start:
                poses[:, k] = self._at_start[name].pose
            for n, state in enumerate(self._poses):
                if name in state:
                    poses[n, k] = state[name]
        return poses
