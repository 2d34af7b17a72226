"""The simulated world: a scene, at most one robot, and the physics between them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
import pybullet
from jaxtyping import Float

from robots.errors import RobotError, SceneError
from robots.simulation.articulation import JointVector
from robots.simulation.base import DriveConfig
from robots.simulation.contacts import Contact, robot_contacts
from robots.simulation.native_output import logged_instead
from robots.simulation.poses import pose_matrix, split_pose
from robots.simulation.primitives import Box, Cylinder, Primitive
from robots.simulation.scene_sdf import SceneField
from robots.simulation.scenes import Scene
from robots.simulation.simulated_robot import GripperModel, MotorConfig, SimulatedRobot
from robots.simulation.urdf_object import UrdfObject

logger = logging.getLogger(__name__)


class World:
    """A scene in a physics client of its own; close it or use it as a context manager.

    Args:
        scene: what the world is filled with.
        timestep: physics step [s].
        gravity: acceleration along z [m/s^2].
    """

    def __init__(self, scene: Scene, *, timestep: float = 1 / 240, gravity: float = -9.81):
        self.scene = scene
        self.timestep = timestep
        self.time = 0.0
        """Simulated time since the world was made [s]."""
        self.client = pybullet.connect(pybullet.DIRECT)
        self._robot: SimulatedRobot | None = None
        self._solids: dict[str, Primitive] = {}
        self._bodies: dict[str, int] = {}
        self._names: dict[int, dict[int, str]] = {}
        self._contacts: dict[tuple[str, str], Contact] = {}
        self.scene_body: int | None = None
        """Body id of the scene's URDF, if it has one."""
        pybullet.setGravity(0, 0, gravity, physicsClientId=self.client)
        pybullet.setTimeStep(timestep, physicsClientId=self.client)
        try:
            if scene.urdf_path is not None:
                self.scene_body = self._load_scene(scene.urdf_path)
            for solid in (*scene.static, *scene.objects):
                self.add_body(solid)
        except Exception:
            self.close()
            raise

    def __enter__(self) -> World:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the physics client; closing twice does no harm."""
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1

    @property
    def robot(self) -> SimulatedRobot:
        """The robot, to command it and read its links.

        Raises:
            RobotError: if none was added.
        """
        if self._robot is None:
            raise RobotError("the world has no robot yet; call add_robot first")
        return self._robot

    @property
    def has_robot(self) -> bool:
        """Whether a robot was added."""
        return self._robot is not None

    def add_robot(
        self,
        urdf_path: str | Path,
        joint_names: Sequence[str],
        q: JointVector,
        *,
        gripper: GripperModel | None = None,
        head_joints: Sequence[str] = (),
        T_world_root: np.ndarray | None = None,
        self_collision: bool = False,
        drive: DriveConfig | None = None,
        motors: MotorConfig | None = None,
    ) -> SimulatedRobot:
        """Load the world's one robot; the arguments are those of `SimulatedRobot`.

        A base on virtual joints hovers at floor level, so its chassis and wheels do not collide with the
        solid named "floor", nor with links of a scene URDF whose names begin so.

        Raises:
            RobotError: if there is a robot already, or the URDF, joints or `q` do not fit.
        """
        if self._robot is not None:
            raise RobotError("the world has a robot already; make another World for another robot")
        self._robot = SimulatedRobot(
            self.client,
            urdf_path,
            joint_names,
            q,
            gripper=gripper,
            head_joints=head_joints,
            T_world_root=T_world_root,
            self_collision=self_collision,
            drive=drive,
            motors=motors,
        )
        self._let_base_hover()
        return self._robot

    def step(self, duration: float | int | None = None) -> None:
        """Advance physics by `duration` [s], rounded to whole physics steps; by one step if None."""
        steps = 1 if duration is None else max(1, round(duration / self.timestep))
        self._contacts = {}
        for _ in range(steps):
            if self._robot is not None:
                self._robot.drive_substep(self.timestep)
            pybullet.stepSimulation(physicsClientId=self.client)
            self.time += self.timestep
            if self._robot is not None:
                self._gather_contacts()

    def robot_state(self) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
        """Joint positions [rad | m] and velocities of the robot, in the order of its `joint_names`."""
        return self.robot.state()

    def command_joints(self, q: JointVector, qdot: JointVector | None = None) -> None:
        """Drive the robot's joints but the base to `q` with feed-forward `qdot`; see `SimulatedRobot`."""
        self.robot.command_joints(q, qdot)

    def command_joint_velocities(self, qdot: JointVector) -> None:
        """Drive the robot's joints but the base with velocities `qdot` (dof,) [rad/s | m/s]."""
        self.robot.command_joint_velocities(qdot)

    def command_base(self, v: float | int, omega: float | int) -> None:
        """Ask the base for forward speed `v` [m/s] and turning rate `omega` [rad/s]."""
        self.robot.command_base(v, omega)

    def command_gripper(self, opening: float | int, force: float | int | None = None) -> None:
        """Move the gripper to `opening` in [0 closed, 1 open] with at most `force` [N]."""
        self.robot.command_gripper(opening, force)

    def command_head(self, pan: float | int, tilt: float | int) -> None:
        """Turn the head to `pan` and `tilt` [rad]."""
        self.robot.command_head(pan, tilt)

    def contacts(self, ignore: Iterable[str] = ()) -> list[Contact]:
        """Deepest contact of each robot link with each body over the last call of `step`.

        Args:
            ignore: names of bodies whose touch is wanted, such as the object being grasped.
        """
        ignored = {ignore} if isinstance(ignore, str) else set(ignore)
        return [contact for contact in self._contacts.values() if contact.body not in ignored]

    @property
    def solids(self) -> dict[str, Primitive]:
        """The solids in the world by name: static ones at their pose, movable ones where they were added."""
        return dict(self._solids)

    def object_pose(self, name: str) -> Float[np.ndarray, "4 4"]:
        """Pose T_world_body of a solid [m].

        Raises:
            SceneError: if there is no such solid.
        """
        return pose_matrix(
            *pybullet.getBasePositionAndOrientation(self.body_id(name), physicsClientId=self.client)
        )

    def set_object_pose(self, name: str, pose: Float[np.ndarray, "4 4"]) -> None:
        """Put a solid at rest at T_world_body [m], outside of physics.

        Raises:
            SceneError: if there is no such solid.
        """
        body = self.body_id(name)
        pybullet.resetBasePositionAndOrientation(body, *split_pose(pose), physicsClientId=self.client)
        pybullet.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0], physicsClientId=self.client)
        if self._solids[name].mass == 0:
            self._solids[name] = self._solids[name].at(pose)

    def add_body(self, solid: Primitive) -> None:
        """Put a solid into the world, static if its mass is 0; possible at any time.

        Raises:
            SceneError: if the name is taken.
        """
        if solid.name in self._bodies:
            raise SceneError(f"a solid named {solid.name!r} is in the world already; choose another name")
        self._bodies[solid.name] = _create_body(self.client, solid)
        self._names[self._bodies[solid.name]] = {-1: solid.name}
        self._solids[solid.name] = solid
        if solid.name == "floor":
            self._let_base_hover()

    def remove_body(self, name: str) -> None:
        """Take a solid out of the world.

        Raises:
            SceneError: if there is no such solid.
        """
        body = self.body_id(name)
        pybullet.removeBody(body, physicsClientId=self.client)
        del self._bodies[name], self._solids[name], self._names[body]

    def field(self) -> SceneField:
        """Ground-truth distance field of the solids where they are now, without the robot and objects of meshes.

        Raises:
            SceneError: if the world has no solids.
        """
        return SceneField(solid.at(self.object_pose(name)) for name, solid in self._solids.items())

    def body_id(self, name: str) -> int:
        """Return pybullet's id of a solid, for what the world has no method for.

        Raises:
            SceneError: if there is no such solid.
        """
        if name not in self._bodies:
            raise SceneError(f"no solid named {name!r} in the world; there are {sorted(self._bodies)}")
        return self._bodies[name]

    def name_of(self, body: int, link: int = -1) -> str:
        """Name of a solid, or of a link of the scene's URDF, by pybullet's numbers."""
        return self._names[body][link]

    def _load_scene(self, path: Path) -> int:
        try:
            with logged_instead(logger):
                body = pybullet.loadURDF(str(path), useFixedBase=True, physicsClientId=self.client)
        except pybullet.error as error:
            raise SceneError(f"pybullet cannot load {path}: {error}; check its mesh paths") from error
        self._names[body] = _link_names(self.client, body)
        return body

    def _let_base_hover(self) -> None:
        if self._robot is None:
            return
        floors = [(self._bodies["floor"], -1)] if "floor" in self._bodies else []
        if self.scene_body is not None:
            links = self._names[self.scene_body]
            floors += [(self.scene_body, i) for i, n in links.items() if n.lower().startswith("floor")]
        for body, floor_link in floors:
            for link in self._robot.ground_links():
                pybullet.setCollisionFilterPair(
                    self._robot.body, body, link, floor_link, 0, physicsClientId=self.client
                )

    def _gather_contacts(self) -> None:
        robot = self.robot
        found = robot_contacts(self.client, robot.body, robot.link_names, self._names)
        for pair, contact in found.items():
            known = self._contacts.get(pair)
            if known is None or contact.depth > known.depth:
                self._contacts[pair] = contact


def _link_names(client: int, body: int) -> dict[int, str]:
    names = {-1: pybullet.getBodyInfo(body, physicsClientId=client)[0].decode()}
    for index in range(pybullet.getNumJoints(body, physicsClientId=client)):
        names[index] = pybullet.getJointInfo(body, index, physicsClientId=client)[12].decode()
    return names


def _create_body(client: int, solid: Primitive) -> int:
    """Make a pybullet body of a solid and return its id."""
    if isinstance(solid, UrdfObject):
        body = pybullet.loadURDF(str(solid.urdf_path), physicsClientId=client)
        # Loading places the link's frame, this its centre of mass.
        pybullet.resetBasePositionAndOrientation(body, *split_pose(solid.pose), physicsClientId=client)
        return body
    if isinstance(solid, Box):
        shape = {"shapeType": pybullet.GEOM_BOX, "halfExtents": list(solid.parameters)}
        drawn = shape
    elif isinstance(solid, Cylinder):
        shape = {"shapeType": pybullet.GEOM_CYLINDER, "radius": solid.radius, "height": solid.height}
        drawn = {"shapeType": pybullet.GEOM_CYLINDER, "radius": solid.radius, "length": solid.height}
    else:
        shape = drawn = {"shapeType": pybullet.GEOM_SPHERE, "radius": solid.bounding_radius}
    position, quaternion = split_pose(solid.pose)
    body = pybullet.createMultiBody(
        baseMass=solid.mass,
        baseCollisionShapeIndex=pybullet.createCollisionShape(**shape, physicsClientId=client),
        baseVisualShapeIndex=pybullet.createVisualShape(
            **drawn, rgbaColor=[*solid.colour, 1], physicsClientId=client
        ),
        basePosition=position,
        baseOrientation=quaternion,
        physicsClientId=client,
    )
    # Spinning and rolling friction keep a standing can from turning and rolling off for ever.
    pybullet.changeDynamics(
        body,
        -1,
        lateralFriction=solid.friction,
        spinningFriction=0.005,
        rollingFriction=0.0005,
        physicsClientId=client,
    )
    return body
