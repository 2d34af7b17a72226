"""Compose URDFs: mount one robot on another, take a part out, put a robot on a planar virtual base."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robots.errors import UnknownLinkError, UrdfError
from robots.kinematic_tree import read_urdf
from robots.mesh_paths import resolve_mesh, write_atomically, write_cached

BASE_JOINTS = ("base_x", "base_y", "base_yaw")


@dataclass(frozen=True)
class Attachment:
    """A URDF to mount by a fixed joint.

    `xyz` [m] and `rpy` [rad] place `child_root_link` of `urdf` in `parent_link` of the base robot;
    `prefix` goes before every link, joint and material name of the attached part.
    """

    urdf: str | Path
    parent_link: str
    child_root_link: str
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    prefix: str = ""


@dataclass(frozen=True)
class PlanarBase:
    """Virtual joints base_x, base_y [m] and base_yaw [rad] between the world and the robot's root link."""

    limit: float = 50.0  # [m] either way: larger than any building floor the planner is used on
    velocity: float = 0.6  # [m/s] in x and in y
    yaw_velocity: float = 1.0  # [rad/s]
    root_link: str = "world"


def compose(
    base_urdf: str | Path,
    attach: Sequence[Attachment] = (),
    planar_base: PlanarBase | bool = False,
    name: str | None = None,
    output: str | Path | None = None,
) -> Path:
    """Write a URDF made of a robot, parts mounted on it and, if wanted, a planar virtual base.

    Mesh paths become absolute, so the file loads from any folder. Simulator and controller extensions
    (<gazebo>, <transmission>) are left out. Links without an inertia get a negligible one, since engines
    otherwise assume a whole kilogram for a mere frame. The file goes to `output`, or else to the user's
    cache under a name keyed by its content. Returns its path; raises `UrdfError` on name clashes and on
    missing links, files or meshes.
    """
    base = read_urdf(base_urdf)
    robot = ElementTree.Element("robot", name=name or base.get("name") or Path(base_urdf).stem)
    robot.extend(_parts(base, base_urdf, prefix=""))
    for attachment in attach:
        _mount(robot, attachment)
    if planar_base:
        _add_planar_base(robot, PlanarBase() if planar_base is True else planar_base)
    _require_unique_names(robot)
    ElementTree.indent(robot)
    text = '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"
    if output is None:
        return write_cached(robot.get("name", "robot"), ".urdf", text)
    write_atomically(Path(output), text)
    return Path(output)


def extract_subtree(urdf: str | Path, root_link: str, output: str | Path | None = None) -> Path:
    """Write the part of a URDF that hangs below (and includes) `root_link` as a URDF of its own.

    Raises `UnknownLinkError` where the link does not exist.
    """
    robot = read_urdf(urdf)
    _require_link(robot, root_link, str(urdf))
    keep = {root_link}
    joints = robot.findall("joint")
    while True:
        added = {_end(j, "child") for j in joints if _end(j, "parent") in keep} - keep
        if not added:
            break
        keep |= added
    part = ElementTree.Element("robot", name=f"{robot.get('name', 'robot')}_{root_link}")
    for element in _parts(robot, urdf, prefix=""):
        dropped_link = element.tag == "link" and element.get("name") not in keep
        dropped_joint = element.tag == "joint" and _end(element, "parent") not in keep
        if not dropped_link and not dropped_joint:
            part.append(element)
    ElementTree.indent(part)
    text = '<?xml version="1.0"?>\n' + ElementTree.tostring(part, encoding="unicode") + "\n"
    if output is None:
        return write_cached(part.get("name", "part"), ".urdf", text)
    write_atomically(Path(output), text)
    return Path(output)


def _parts(robot: ElementTree.Element, path: str | Path, prefix: str) -> list[ElementTree.Element]:
    """Copies of the links, joints and materials, names prefixed and meshes resolved."""
    parts = [copy.deepcopy(e) for e in robot if e.tag in ("link", "joint", "material")]
    for part in parts:
        part.set("name", prefix + part.get("name", ""))
        for tag, key in (("parent", "link"), ("child", "link"), ("mimic", "joint"), ("material", "name")):
            for reference in part.iter(tag):
                if reference is not part and reference.get(key):
                    reference.set(key, prefix + reference.get(key, ""))
        for mesh in part.iter("mesh"):
            mesh.set("filename", str(resolve_mesh(mesh.get("filename", ""), path)))
        if part.tag == "link" and part.find("inertial") is None:
            part.append(_inertial(mass=1e-3, moment=1e-6))
        for inertia in part.iter("inertia"):
            _make_possible(inertia)
    return parts


def _make_possible(inertia: ElementTree.Element) -> None:
    """Replace an inertia that no body can have by that of a ball with the same trace.

    Published URDFs hold some; simulators set them to zero and warn. The principal moments of a body are positive and
    none exceeds the sum of the others.
    """
    xx, xy, xz, yy, yz, zz = (float(inertia.get(k, "0")) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    low, middle, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if low > 0 and high <= (low + middle) * (1 + 1e-6):
        return
    moment = repr(max((xx + yy + zz) / 3, 1e-9))
    inertia.attrib.update(ixx=moment, iyy=moment, izz=moment, ixy="0", ixz="0", iyz="0")


def _mount(robot: ElementTree.Element, attachment: Attachment) -> None:
    part = read_urdf(attachment.urdf)
    _require_link(robot, attachment.parent_link, "the base robot")
    _require_link(part, attachment.child_root_link, str(attachment.urdf))
    if any(_end(joint, "child") == attachment.child_root_link for joint in part.findall("joint")):
        raise UrdfError(
            f"{attachment.child_root_link!r} is not the root of {attachment.urdf}; "
            "take the part out with extract_subtree first"
        )
    robot.extend(_parts(part, attachment.urdf, attachment.prefix))
    child = attachment.prefix + attachment.child_root_link
    robot.append(
        _joint(f"{child}_mount", "fixed", attachment.parent_link, child, attachment.xyz, attachment.rpy)
    )


def _add_planar_base(robot: ElementTree.Element, base: PlanarBase) -> None:
    children = {_end(joint, "child") for joint in robot.findall("joint")}
    roots = [link.get("name", "") for link in robot.findall("link") if link.get("name") not in children]
    if len(roots) != 1:
        raise UrdfError(f"a planar base needs one root link, found {roots}")
    # Links between the virtual joints need some inertia, or dynamics engines divide by zero.
    for link in (base.root_link, "base_x_link", "base_y_link"):
        element = ElementTree.SubElement(robot, "link", name=link)
        element.append(_inertial(mass=0.1, moment=1e-3))
    chain = (base.root_link, "base_x_link", "base_y_link", roots[0])
    for i, (joint, axis) in enumerate(zip(BASE_JOINTS, ("1 0 0", "0 1 0", "0 0 1"), strict=True)):
        kind = "continuous" if joint == "base_yaw" else "prismatic"
        element = _joint(joint, kind, chain[i], chain[i + 1])
        ElementTree.SubElement(element, "axis", xyz=axis)
        velocity = base.yaw_velocity if kind == "continuous" else base.velocity
        limit = ElementTree.SubElement(element, "limit", effort="1000", velocity=repr(velocity))
        if kind == "prismatic":
            limit.set("lower", repr(-base.limit))
            limit.set("upper", repr(base.limit))
        robot.append(element)


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: Sequence[float] = (0.0, 0.0, 0.0),
    rpy: Sequence[float] = (0.0, 0.0, 0.0),
) -> ElementTree.Element:
    element = ElementTree.Element("joint", name=name, type=kind)
    ElementTree.SubElement(element, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy))
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)
    return element


def _inertial(mass: float, moment: float) -> ElementTree.Element:
    element = ElementTree.Element("inertial")
    ElementTree.SubElement(element, "origin", xyz="0 0 0", rpy="0 0 0")
    ElementTree.SubElement(element, "mass", value=repr(mass))
    diagonal = {key: repr(moment) for key in ("ixx", "iyy", "izz")}
    ElementTree.SubElement(element, "inertia", {**diagonal, "ixy": "0", "ixz": "0", "iyz": "0"})
    return element


def _require_unique_names(robot: ElementTree.Element) -> None:
    for tag in ("link", "joint"):
        names = [element.get("name") for element in robot.findall(tag)]
        twice = sorted({str(n) for n in names if names.count(n) > 1})
        if twice:
            raise UrdfError(f"{tag} names occur twice after composing: {twice}; give the attachment a prefix")


def _require_link(robot: ElementTree.Element, link: str, where: str) -> None:
    links = [element.get("name") for element in robot.findall("link")]
    if link not in links:
        raise UnknownLinkError(f"no link {link!r} in {where}; links: {links}")


def _end(joint: ElementTree.Element, tag: str) -> str:
    element = joint.find(tag)
    return "" if element is None else element.get("link", "")


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
