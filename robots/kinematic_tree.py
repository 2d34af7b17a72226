"""The links and joints of a URDF, with reference kinematics in float64 numpy."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robots.errors import UnknownJointError, UnknownLinkError, UrdfError

MOVABLE_TYPES = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another: value = multiplier * value(joint) + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """One URDF joint; `origin` maps the joint frame to the parent link, angles in rad, lengths in m."""

    name: str
    kind: str
    parent: str
    child: str
    origin: np.ndarray
    axis: np.ndarray
    lower: float
    upper: float
    velocity: float | None
    mimic: Mimic | None

    @property
    def movable(self) -> bool:
        """Whether the joint has a value (revolute, continuous or prismatic)."""
        return self.kind in MOVABLE_TYPES

    def motion(self, value: float) -> np.ndarray:
        """Transform (4, 4) of the child link relative to the joint frame at a joint value [rad | m]."""
        transform = np.eye(4)
        if self.kind == "prismatic":
            transform[:3, 3] = self.axis * value
        elif self.movable:
            transform[:3, :3] = rotation_about(self.axis, value)
        return transform


@dataclass(frozen=True)
class KinematicTree:
    """A URDF read once: joints sorted from the root outwards, and transforms between its links."""

    name: str
    root: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]

    @classmethod
    def from_urdf(cls, path: str | Path) -> KinematicTree:
        """Read a URDF file; raises `UrdfError` where it is missing, malformed or not a single tree."""
        robot = read_urdf(path)
        links = tuple(_attribute(link, "name", path) for link in robot.findall("link"))
        joints = [_parse_joint(element, path) for element in robot.findall("joint")]
        children = [joint.child for joint in joints]
        for joint in joints:
            for link in (joint.parent, joint.child):
                if link not in links:
                    raise UrdfError(
                        f"{path}: joint {joint.name!r} refers to link {link!r}, which is not there"
                    )
        _check_mimics(joints, path)
        roots = [link for link in links if link not in children]
        if len(roots) != 1 or len(set(children)) != len(children):
            raise UrdfError(f"{path}: the links must form one tree; found {len(roots)} roots: {roots}")
        return cls(robot.get("name", Path(path).stem), roots[0], links, _sorted_outwards(joints, roots[0]))

    @property
    def movable_joints(self) -> tuple[str, ...]:
        """Names of the joints that have a value of their own (mimicking joints excluded), root first."""
        return tuple(joint.name for joint in self.joints if joint.movable and joint.mimic is None)

    def joint(self, name: str) -> Joint:
        """Look a joint up by name; raises `UnknownJointError` listing the movable ones."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise UnknownJointError(f"no joint {name!r} in {self.name!r}; movable joints: {self.movable_joints}")

    def require_link(self, name: str) -> str:
        """Return the name if such a link exists; raises `UnknownLinkError` listing all links."""
        if name not in self.links:
            raise UnknownLinkError(f"no link {name!r} in {self.name!r}; links: {self.links}")
        return name

    def value_of(self, joint: Joint, values: Mapping[str, float]) -> float:
        """Value of a joint [rad | m] given the values of the others (0 where not given, mimics resolved)."""
        if joint.mimic is not None:
            source = self.value_of(self.joint(joint.mimic.joint), values)
            return joint.mimic.multiplier * source + joint.mimic.offset
        return float(values.get(joint.name, 0.0))

    def neighbours(self, bodies: Collection[str]) -> frozenset[frozenset[str]]:
        """Pairs of `bodies` joined in the tree with no other body between them; bare frames do not count."""
        carrier = {self.root: self.root if self.root in bodies else None}
        pairs = set()
        for joint in self.joints:
            above = carrier[joint.parent]
            carrier[joint.child] = joint.child if joint.child in bodies else above
            if joint.child in bodies and above is not None:
                pairs.add(frozenset((above, joint.child)))
        return frozenset(pairs)

    def rigid_bodies(self, links: Collection[str]) -> list[tuple[str, ...]]:
        """Some links, grouped by what fixed joints hold together, in the tree's order."""
        body_of = {self.root: self.root}
        groups: dict[str, list[str]] = {self.root: [self.root]}
        for joint in self.joints:
            body = joint.child if joint.movable else body_of[joint.parent]
            body_of[joint.child] = body
            groups.setdefault(body, []).append(joint.child)
        kept = (tuple(link for link in group if link in links) for group in groups.values())
        return [group for group in kept if group]

    def link_transforms(self, values: Mapping[str, float]) -> dict[str, np.ndarray]:
        """T_root_link (4, 4) of every link, float64, at the given joint values [rad | m] (0 where not given)."""
        transforms = {self.root: np.eye(4)}
        for joint in self.joints:
            motion = joint.motion(self.value_of(joint, values))
            transforms[joint.child] = transforms[joint.parent] @ joint.origin @ motion
        return transforms


def read_urdf(path: str | Path) -> ElementTree.Element:
    """Parse a URDF and return its <robot> element; raises `UrdfError`."""
    try:
        root = ElementTree.parse(path).getroot()
    except FileNotFoundError as error:
        raise UrdfError(f"no URDF at {str(path)!r}") from error
    except ElementTree.ParseError as error:
        raise UrdfError(f"{path} is not well-formed XML: {error}") from error
    if root.tag != "robot":
        raise UrdfError(f"{path}: the root element is <{root.tag}>, a URDF starts with <robot>")
    return root


def pose_matrix(xyz: np.ndarray, rpy: np.ndarray) -> np.ndarray:
    """Transform (4, 4) from a translation [m] and fixed-axis roll, pitch, yaw [rad], as URDF defines them."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    transform = np.eye(4)
    transform[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    transform[:3, 3] = xyz
    return transform


def roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """Fixed-axis roll, pitch, yaw [rad] of a rotation matrix (3, 3); yaw is 0 in gimbal lock."""
    cos_pitch = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], cos_pitch)
    if cos_pitch < 1e-9:
        return np.array([math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])])


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) about a unit axis by an angle [rad] (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def parse_origin(element: ElementTree.Element | None) -> np.ndarray:
    """Transform (4, 4) of a URDF <origin> element, identity where it is absent."""
    if element is None:
        return np.eye(4)
    return pose_matrix(*(_vector(element.get(key, "0 0 0"), f"<origin {key}>") for key in ("xyz", "rpy")))


def _parse_joint(element: ElementTree.Element, path: str | Path) -> Joint:
    name, kind = _attribute(element, "name", path), _attribute(element, "type", path)
    if kind not in (*MOVABLE_TYPES, "fixed"):
        raise UrdfError(f"{path}: joint {name!r} is {kind!r}; supported are {MOVABLE_TYPES} and fixed")
    ends = [element.find(tag) for tag in ("parent", "child")]
    if any(end is None or "link" not in end.attrib for end in ends):
        raise UrdfError(f"{path}: joint {name!r} needs <parent link=...> and <child link=...>")
    axis_element, limit, mimic = element.find("axis"), element.find("limit"), element.find("mimic")
    axis = np.array([1.0, 0.0, 0.0])
    if axis_element is not None:
        axis = _vector(axis_element.get("xyz", "1 0 0"), f"{path}: <axis> of joint {name!r}")
    if kind != "fixed":
        if np.linalg.norm(axis) < 1e-9:
            raise UrdfError(f"{path}: joint {name!r} has a zero axis")
        axis = axis / np.linalg.norm(axis)
    lower, upper, velocity = -math.inf, math.inf, None
    if limit is not None:
        if kind != "continuous":
            lower, upper = (_number(limit, key, 0.0, name, path) for key in ("lower", "upper"))
        velocity = _number(limit, "velocity", 0.0, name, path)
    if lower > upper:
        raise UrdfError(f"{path}: joint {name!r} has lower limit {lower} above upper limit {upper}")
    follows = None
    if mimic is not None:
        follows = Mimic(
            _attribute(mimic, "joint", path),
            _number(mimic, "multiplier", 1.0, name, path),
            _number(mimic, "offset", 0.0, name, path),
        )
    parent, child = (end.get("link", "") for end in ends if end is not None)
    origin = parse_origin(element.find("origin"))
    return Joint(name, kind, parent, child, origin, axis, lower, upper, velocity or None, follows)


def _sorted_outwards(joints: list[Joint], root: str) -> tuple[Joint, ...]:
    """Depth-first order, so that a parent's joint comes before its children's and a chain stays together."""
    by_parent: dict[str, list[Joint]] = {}
    for joint in joints:
        by_parent.setdefault(joint.parent, []).append(joint)
    ordered: list[Joint] = []
    stack = list(reversed(by_parent.get(root, [])))
    while stack:
        joint = stack.pop()
        ordered.append(joint)
        stack.extend(reversed(by_parent.get(joint.child, [])))
    return tuple(ordered)


def _attribute(element: ElementTree.Element, key: str, path: str | Path) -> str:
    value = element.get(key)
    if not value:
        raise UrdfError(f"{path}: a <{element.tag}> element has no {key!r} attribute")
    return value


def _check_mimics(joints: list[Joint], path: str | Path) -> None:
    """Raise `UrdfError` where a name occurs twice, or a joint mimics one that is absent, fixed or follows it."""
    by_name = {joint.name: joint for joint in joints}
    if len(by_name) < len(joints):
        names = [joint.name for joint in joints]
        raise UrdfError(
            f"{path}: joint names occur twice: {sorted({n for n in names if names.count(n) > 1})}"
        )
    for joint in joints:
        seen, leader = [joint.name], joint
        while leader.mimic is not None:
            if leader.mimic.joint not in by_name or not by_name[leader.mimic.joint].movable:
                movable = [other.name for other in joints if other.movable]
                raise UrdfError(
                    f"{path}: joint {leader.name!r} mimics {leader.mimic.joint!r}, which is no movable joint; "
                    f"movable ones: {movable}"
                )
            leader = by_name[leader.mimic.joint]
            if leader.name in seen:
                raise UrdfError(f"{path}: joints mimic one another in a circle: {[*seen, leader.name]}")
            seen.append(leader.name)


def _number(element: ElementTree.Element, key: str, default: float, joint: str, path: str | Path) -> float:
    text = element.get(key)
    try:
        value = default if text is None else float(text)
    except ValueError as error:
        raise UrdfError(
            f"{path}: <{element.tag} {key}={text!r}> of joint {joint!r} is not a number"
        ) from error
    if math.isnan(value):
        raise UrdfError(f"{path}: <{element.tag} {key}> of joint {joint!r} is NaN")
    return value


def _vector(text: str, where: str) -> np.ndarray:
    """Three finite numbers (3,); raises `UrdfError`."""
    try:
        vector = np.array(text.split(), dtype=float)
    except ValueError:
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise UrdfError(f"{where} is {text!r}; expected three numbers")
    return vector
