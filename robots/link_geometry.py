"""Collision geometry of URDF links as convex pieces in the link's frame."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import trimesh

from robots.errors import UrdfError
from robots.kinematic_tree import parse_origin, read_urdf
from robots.mesh_paths import resolve_mesh


def collision_pieces(urdf: str | Path, keep_concave: bool = False) -> dict[str, list[trimesh.Trimesh]]:
    """Convex pieces of every link that has collision geometry, in the link frame [m].

    A mesh is replaced by its convex hull, as rigid-body engines do, so that spheres covering the pieces
    also cover what the engine collides. With `keep_concave` those marked `<collision concave="yes">`, which
    engines collide as they are, stay so.
    """
    robot = read_urdf(urdf)
    pieces: dict[str, list[trimesh.Trimesh]] = {}
    for link in robot.findall("link"):
        found = [_piece(collision, urdf, keep_concave) for collision in link.findall("collision")]
        if found:
            pieces[link.get("name", "")] = found
    return pieces


def _piece(collision: ElementTree.Element, urdf: str | Path, keep_concave: bool) -> trimesh.Trimesh:
    geometry = collision.find("geometry")
    if geometry is None or len(geometry) == 0:
        raise UrdfError(f"{urdf}: a <collision> element has no geometry")
    shape = geometry[0]
    if shape.tag == "mesh":
        loaded = trimesh.load_mesh(str(resolve_mesh(shape.get("filename", ""), urdf)))
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_mesh()
        scale = np.array(shape.get("scale", "1 1 1").split(), dtype=float)
        piece = trimesh.Trimesh(loaded.vertices * scale, loaded.faces)
        if not (keep_concave and collision.get("concave") == "yes"):
            piece = piece.convex_hull
    elif shape.tag == "box":
        piece = trimesh.creation.box(np.array(shape.get("size", "").split(), dtype=float))
    elif shape.tag == "cylinder":
        piece = trimesh.creation.cylinder(
            float(shape.get("radius", 0)), float(shape.get("length", 0)), sections=48
        )
    elif shape.tag == "sphere":
        piece = trimesh.creation.icosphere(subdivisions=3, radius=float(shape.get("radius", 0)))
    else:
        raise UrdfError(
            f"{urdf}: collision geometry <{shape.tag}> is not supported (mesh, box, cylinder, sphere)"
        )
    return piece.apply_transform(parse_origin(collision.find("origin")))
