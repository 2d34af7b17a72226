"""A robot as a planner sees it: collision spheres and link poses as differentiable functions of q."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from robots.errors import RobotError, SphereFileError, UnknownJointError
from robots.fine_cover import fine_cover
from robots.gripper import Gripper
from robots.joint_chain import JointChain, joint_chain
from robots.kinematic_tree import KinematicTree
from robots.moving_frames import MovingFrames
from robots.spheres import SphereSet, load_spheres

logger = logging.getLogger(__name__)

# A planner cannot time a joint without a velocity limit; these are slow for any arm or lift on the market.
DEFAULT_VELOCITY = {"revolute": 1.0, "continuous": 1.0, "prismatic": 0.1}  # [rad/s], [rad/s], [m/s]


class Robot:
    """A URDF robot with collision spheres; satisfies the planner's `SphereRobot` protocol.

    Build one with `Robot.from_urdf` or `robots.load`. A robot is immutable: `with_fixed` returns another.
    The order of q is `joint_names`; all other joints are held at `held` (0 where not given), mimicking
    joints follow theirs.
    """

    def __init__(
        self,
        tree: KinematicTree,
        sphere_set: SphereSet,
        *,
        urdf_path: Path,
        joints: Sequence[str],
        held: Mapping[str, float],
        named: Mapping[str, Mapping[str, float]],
        tool_link: str | None = None,
        gripper: Gripper | None = None,
        head_joints: Sequence[str] = (),
        camera_link: str | None = None,
    ) -> None:
        """Use `Robot.from_urdf`, which reads and checks the files."""
        self.tree = tree
        self.sphere_set = sphere_set
        self.urdf_path = urdf_path
        self.held = dict(held)
        self.tool_link = tool_link
        self.gripper = gripper
        self.head_joints = tuple(head_joints)
        self.camera_link = camera_link
        self._named = {name: dict(values) for name, values in named.items()}
        self._joints = tuple(joints)
        self._check_names()
        self._frames = MovingFrames(tree, self._joints, self.held)
        self._placed = _place_spheres(sphere_set, self._frames)
        self._pairs = _sphere_pairs(tree, sphere_set, self._frames)
        self._constants: dict[tuple[torch.dtype, torch.device], tuple[Tensor, Tensor, Tensor]] = {}

    @classmethod
    def from_urdf(
        cls,
        urdf_path: str | Path,
        spheres: SphereSet | str | Path,
        *,
        joints: Sequence[str] | None = None,
        planar_base: bool = False,
        tool_link: str | None = None,
        gripper: Gripper | None = None,
        rest: Mapping[str, float] | None = None,
        named: Mapping[str, Mapping[str, float]] | None = None,
        held: Mapping[str, float] | None = None,
        head_joints: Sequence[str] = (),
        camera_link: str | None = None,
    ) -> Robot:
        """Build a robot from a URDF and its spheres.

        Args:
            urdf_path: the URDF; `package://` meshes are resolved by `robots.mesh_paths`.
            spheres: a sphere set or a YAML file in cuRobo's layout (`robots.load_spheres`).
            joints: the planned joints in the order of q; by default all movable joints that neither
                mimic another nor belong to the gripper or the head.
            planar_base: put the robot on the virtual joints base_x, base_y [m], base_yaw [rad].
            tool_link: the link to place when reaching, e.g. the point between the fingertips.
            gripper: the gripper's joints and positions.
            rest: joint values [rad | m] of a comfortable posture, the middle of the limits where absent.
            named: further named postures.
            held: values of joints that are not planned; gripper joints are held open by default.
            head_joints: the pan and tilt joints that `camera_pose` sets.
            camera_link: the depth camera's optical frame (x right, y down, z forward).

        Raises `UrdfError`, `SphereFileError`, `UnknownJointError` and `UnknownLinkError`.
        """
        path = Path(urdf_path)
        if planar_base:
            from robots.urdf import compose

            path = compose(path, planar_base=True)
        tree = KinematicTree.from_urdf(path)
        sphere_set = spheres if isinstance(spheres, SphereSet) else load_spheres(spheres)
        gripper_joints = gripper.joint_names if gripper else ()
        if joints is None:
            joints = [j for j in tree.movable_joints if j not in gripper_joints and j not in head_joints]
        opened = dict(zip(gripper_joints, gripper.open_position, strict=True)) if gripper else {}
        return cls(
            tree,
            sphere_set,
            urdf_path=path,
            joints=joints,
            held={**opened, **(held or {})},
            named={**(named or {}), "rest": dict(rest or {})},
            tool_link=tool_link,
            gripper=gripper,
            head_joints=head_joints,
            camera_link=camera_link,
        )

    def __repr__(self) -> str:
        joints = ", ".join(self.joint_names)
        return f"<Robot {self.name}: {self.num_dofs} joints ({joints}), {len(self.sphere_links)} spheres>"

    def _repr_png_(self) -> bytes:
        """For notebooks: hulls and spheres at rest."""
        from robots.sphere_figure import sphere_figure

        return sphere_figure(self)._repr_png_()

    @property
    def name(self) -> str:
        """The name in the URDF."""
        return self.tree.name

    @property
    def num_dofs(self) -> int:
        """Number of planned joints."""
        return len(self._joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Planned joints in the order of q."""
        return self._joints

    @property
    def joint_limits(self) -> Float[Tensor, "dof 2"]:
        """Lower and upper limits [rad | m], -inf and inf where unlimited."""
        return torch.tensor([[j.lower, j.upper] for j in map(self.tree.joint, self._joints)])

    @property
    def velocity_limits(self) -> Float[Tensor, " dof"]:
        """Speed limits [rad/s | m/s] from the URDF; `DEFAULT_VELOCITY` where it has none or zero."""
        limits = []
        for joint in map(self.tree.joint, self._joints):
            if joint.velocity is None:
                logger.warning("joint %s has no velocity limit; using the default", joint.name)
            limits.append(joint.velocity or DEFAULT_VELOCITY[joint.kind])
        return torch.tensor(limits)

    @property
    def sphere_links(self) -> tuple[str, ...]:
        """The link that each sphere belongs to."""
        return tuple(link for link, rows in self.sphere_set.spheres.items() for _ in rows)

    @property
    def self_collision_pairs(self) -> Int[Tensor, "pairs 2"]:
        """Pairs of sphere indices that can move against each other and must not touch."""
        return self._pairs

    @cached_property
    def chain(self) -> JointChain:
        """The moving joints as arrays."""
        return joint_chain(self._frames)

    @property
    def placed_spheres(self) -> tuple[Int[np.ndarray, " s"], Float[np.ndarray, "s 4"]]:
        """Of each sphere the moving frame that carries it, and its centre there with its radius [m]."""
        return self._placed

    def fine_spheres(self) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m 4"], Int[np.ndarray, " m"]]:
        """Of a much finer cover of the links that have spheres: moving frame, centre there with radius [m], link.

        Links are numbered as in `link_pairs`. The first use of a geometry takes seconds; then it is cached.
        """
        return self._fine_spheres

    @cached_property
    def _fine_spheres(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        links = tuple(self.sphere_set.spheres)
        cover = fine_cover(self.urdf_path)
        balls = {link: cover.get(link, rows) for link, rows in self.sphere_set.spheres.items()}
        frame, placed = _place_spheres(SphereSet(balls), self._frames)
        return frame, placed, np.repeat(np.arange(len(links)), [len(balls[link]) for link in links])

    @property
    def link_pairs(self) -> Int[np.ndarray, "pairs 2"]:
        """Pairs of links, by their place among those with spheres, that must not touch."""
        return _link_pairs(self.tree, self.sphere_set, self._frames)

    @property
    def floor_spheres(self) -> Bool[Tensor, " spheres"]:
        """Which spheres belong to links that drive on the floor."""
        return torch.tensor([link in self.sphere_set.floor_links for link in self.sphere_links])

    @property
    def named(self) -> dict[str, Float[Tensor, " dof"]]:
        """Named postures as q (dof,); joints that a posture leaves out are at `rest`."""
        return {name: self._posture(values) for name, values in self._named.items()}

    @property
    def rest(self) -> Float[Tensor, " dof"]:
        """The resting posture (dof,) [rad | m]."""
        return self._posture({})

    def spheres(
        self, q: Float[Tensor, "*batch dof"]
    ) -> tuple[Float[Tensor, "*batch spheres 3"], Float[Tensor, " spheres"]]:
        """Collision spheres at configurations q [rad | m]: centres [m, world] and radii [m], differentiable.

        Raises `RobotError` if q has another number of joints or is not finite.
        """
        flat = self._checked(q).reshape(-1, self.num_dofs)
        frame, offset, radii = self._sphere_constants(q)
        transforms = self._frames(flat)[:, :, :3].index_select(0, frame)
        centres = (transforms @ offset[:, None, :, None]).squeeze(-1)
        return centres.transpose(0, 1).reshape(*q.shape[:-1], len(radii), 3), radii

    def link_poses(
        self, q: Float[Tensor, "*batch dof"], links: Sequence[str]
    ) -> Float[Tensor, "*batch links 4 4"]:
        """Poses T_world_link (4, 4) [m] of some links, differentiable; raises `UnknownLinkError`."""
        flat = self._checked(q).reshape(-1, self.num_dofs)
        places = [self._frames.place(self.tree.require_link(link)) for link in links]
        offsets = torch.as_tensor(np.stack([offset for _, offset in places])).to(q)
        transforms = self._frames(flat)[[frame for frame, _ in places]]
        poses = (transforms @ offsets[:, None]).transpose(0, 1)
        return poses.reshape(*q.shape[:-1], len(links), 4, 4)

    def joint_values(self, q: Float[Tensor, " dof"]) -> dict[str, float]:
        """Values [rad | m] of all movable joints of the URDF at q, held and mimicking ones included."""
        values = {**self.held, **dict(zip(self._joints, self._checked(q).tolist(), strict=True))}
        return {joint.name: self.tree.value_of(joint, values) for joint in self.tree.joints if joint.movable}

    def camera_pose(self, q: Float[Tensor, " dof"], head: Sequence[float] | None = None) -> np.ndarray:
        """T_world_camera (4, 4) float64 of the depth camera, OpenCV axes; `head` sets the head joints [rad].

        Raises `RobotError` where the robot has no camera or `head` has the wrong length.
        """
        if self.camera_link is None:
            raise RobotError(f"{self.name!r} has no camera_link; give one to Robot.from_urdf")
        values = self.joint_values(q)
        if head is not None:
            if len(head) != len(self.head_joints):
                raise RobotError(f"head has {len(head)} values, expected one for each of {self.head_joints}")
            values.update(zip(self.head_joints, map(float, head), strict=True))
        return self.tree.link_transforms(values)[self.camera_link]

    @property
    def holdable_joints(self) -> tuple[str, ...]:
        """Joints that `with_fixed` accepts: all that have a value of their own."""
        return self.tree.movable_joints

    def with_fixed(self, values: Mapping[str, float]) -> Robot:
        """A robot that holds these joints [rad | m] and plans the rest, e.g. the arm of a parked base.

        Joints that are already held get a new value. Raises `UnknownJointError` for other names.
        """
        allowed = self.tree.movable_joints
        unknown = sorted(set(values) - set(allowed))
        if unknown:
            raise UnknownJointError(f"cannot fix {unknown}; joints that can be held: {allowed}")
        joints = tuple(joint for joint in self._joints if joint not in values)
        return self._changed(
            joints=joints, held={**self.held, **{name: float(value) for name, value in values.items()}}
        )

    def with_spheres(self, spheres: SphereSet | str | Path) -> Robot:
        """The same robot covered by another sphere set; raises `SphereFileError` and `UnknownLinkError`."""
        return self._changed(sphere_set=spheres if isinstance(spheres, SphereSet) else load_spheres(spheres))

    def _changed(
        self,
        *,
        sphere_set: SphereSet | None = None,
        joints: Sequence[str] | None = None,
        held: Mapping[str, float] | None = None,
    ) -> Robot:
        return Robot(
            self.tree,
            self.sphere_set if sphere_set is None else sphere_set,
            urdf_path=self.urdf_path,
            joints=self._joints if joints is None else joints,
            held=self.held if held is None else held,
            named=self._named,
            tool_link=self.tool_link,
            gripper=self.gripper,
            head_joints=self.head_joints,
            camera_link=self.camera_link,
        )

    def _check_names(self) -> None:
        if not self._joints:
            raise RobotError(f"{self.name!r} would have no planned joint left")
        given = [*self._joints, *self.held, *self.head_joints]
        given += [name for values in self._named.values() for name in values]
        given += self.gripper.joint_names if self.gripper else ()
        for name in given:
            joint = self.tree.joint(name)
            if not joint.movable or joint.mimic is not None:
                raise UnknownJointError(f"joint {name!r} cannot be set: it is fixed or mimics another")
        if len(set(self._joints)) != len(self._joints):
            raise RobotError(f"planned joints are named twice: {self._joints}")
        for link in filter(None, (self.tool_link, self.camera_link)):
            self.tree.require_link(link)
        self.sphere_set.check_links(self.tree.links)
        if len(self.sphere_set) == 0:
            raise SphereFileError(f"{self.name!r} has no collision sphere; give at least one")

    def _checked(self, q: Tensor) -> Tensor:
        if q.ndim == 0 or q.shape[-1] != self.num_dofs:
            raise RobotError(
                f"q has shape {tuple(q.shape)}, expected (..., {self.num_dofs}) for {self.name!r}: {self._joints}"
            )
        if not torch.isfinite(q).all():
            finite = torch.isfinite(q).reshape(-1, self.num_dofs).all(0).tolist()
            bad = [joint for joint, good in zip(self._joints, finite, strict=True) if not good]
            raise RobotError(f"q is NaN or infinite at joints {bad} of {self.name!r}; expected finite values")
        return q

    def _posture(self, values: Mapping[str, float]) -> Tensor:
        values = {**self._named.get("rest", {}), **values}
        posture = []
        for joint in map(self.tree.joint, self._joints):
            bounded = math.isfinite(joint.lower) and math.isfinite(joint.upper)
            middle = (joint.lower + joint.upper) / 2 if bounded else 0.0
            posture.append(float(values.get(joint.name, middle)))
        return torch.tensor(posture)

    def _sphere_constants(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        key = (like.dtype, like.device)
        if key not in self._constants:
            frame, rows = self._placed
            homogeneous = np.concatenate([rows[:, :3], np.ones((len(rows), 1))], axis=1)
            self._constants[key] = (
                torch.as_tensor(frame, device=like.device),
                torch.as_tensor(homogeneous).to(like),
                torch.as_tensor(rows[:, 3]).to(like),
            )
        return self._constants[key]


def _place_spheres(sphere_set: SphereSet, frames: MovingFrames) -> tuple[np.ndarray, np.ndarray]:
    """Moving frame of each sphere (s,) and its centre in that frame with its radius (s, 4)."""
    indices, placed = [], []
    for link, rows in sphere_set.spheres.items():
        frame, offset = frames.place(link)
        centres = rows[:, :3] @ offset[:3, :3].T + offset[:3, 3]
        indices += [frame] * len(rows)
        placed.append(np.concatenate([centres, rows[:, 3:]], axis=1))
    return np.array(indices, dtype=np.int64), np.concatenate(placed)


def _sphere_pairs(tree: KinematicTree, sphere_set: SphereSet, frames: MovingFrames) -> Tensor:
    """Pairs of spheres of links that must not touch."""
    first = np.cumsum([0, *(len(rows) for rows in sphere_set.spheres.values())])
    pairs = []
    for a, b in _link_pairs(tree, sphere_set, frames):
        pairs += [(i, j) for i in range(first[a], first[a + 1]) for j in range(first[b], first[b + 1])]
    return torch.tensor(pairs, dtype=torch.long).reshape(-1, 2)


def _link_pairs(tree: KinematicTree, sphere_set: SphereSet, frames: MovingFrames) -> np.ndarray:
    """Pairs (p, 2) of links that move against each other, are not neighbours and are not ignored."""
    ignored = sphere_set.ignored_pairs | tree.neighbours(sphere_set.spheres)
    names = tuple(sphere_set.spheres)
    pairs = [
        (a, b)
        for a, b in itertools.combinations(range(len(names)), 2)
        if frozenset((names[a], names[b])) not in ignored
        and frames.place(names[a])[0] != frames.place(names[b])[0]
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
