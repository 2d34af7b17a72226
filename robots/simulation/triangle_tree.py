"""A tree of boxes over triangles, and the signed distance of points to the solids that these enclose."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from numba import njit

LEAF = 6
"""Triangles that a box without children holds at most."""
DEEPEST = 64
"""Boxes that wait while a tree is searched; halving a billion triangles takes half as many."""


class TriangleTree(NamedTuple):
    """Triangles of several bodies, each below a root of its own.

    Args:
        corners: of the triangles [m].
        normals: of each triangle's features: corners a, b, c, edges ab, bc, ca, and the face. Those of corners are
            weighted by angle, so that their side tells inside from outside (Baerentzen and Aanaes 2005); not unit.
        lower: corner of each node's box [m].
        upper: the opposite one [m].
        first: a leaf's first triangle.
        held: triangles of a leaf, 0 for an inner node, whose left child follows it.
        right: the other child of an inner node.
        root: node of each body.
        closed: bodies that enclose a volume: everything outside of their box is outside of them.
    """

    corners: Float[np.ndarray, "m 3 3"]
    normals: Float[np.ndarray, "m 7 3"]
    lower: Float[np.ndarray, "n 3"]
    upper: Float[np.ndarray, "n 3"]
    first: Int[np.ndarray, " n"]
    held: Int[np.ndarray, " n"]
    right: Int[np.ndarray, " n"]
    root: Int[np.ndarray, " b"]
    closed: Bool[np.ndarray, " b"]


def build(bodies: Sequence[trimesh.Trimesh], closed: Sequence[bool]) -> TriangleTree:
    """Sort the triangles of bodies into boxes, halving the longest side of their centres' box at the median."""
    corners = np.concatenate([np.asarray(body.triangles, dtype=np.float64) for body in bodies])
    normals = np.concatenate([feature_normals(body) for body in bodies])
    centres, order = corners.mean(axis=1), np.arange(len(corners))
    nodes: list[list[int]] = []  # first, held, right
    boxes: list[np.ndarray] = []

    def split(begin: int, end: int) -> int:
        node, inside = len(nodes), corners[order[begin:end]].reshape(-1, 3)
        nodes.append([begin, end - begin, -1])
        boxes.append(np.stack([inside.min(axis=0), inside.max(axis=0)]))
        if end - begin > LEAF:
            middles = centres[order[begin:end]]
            middle, axis = (end - begin) // 2, int(np.ptp(middles, axis=0).argmax())
            order[begin:end] = order[begin:end][np.argpartition(middles[:, axis], middle)]
            split(begin, begin + middle)
            nodes[node][1:] = [0, split(begin + middle, end)]
        return node

    ends = np.cumsum([0, *(len(body.faces) for body in bodies)])
    roots = [split(int(begin), int(end)) for begin, end in itertools.pairwise(ends)]
    first, held, right = np.array(nodes, dtype=np.int64).T.copy()
    lower, upper = np.stack(boxes, axis=1)
    return TriangleTree(
        corners[order], normals[order], lower, upper, first, held, right, np.array(roots), np.array(closed)
    )


def feature_normals(mesh: trimesh.Trimesh) -> Float[np.ndarray, "m 7 3"]:
    """Normals of every triangle's corners, edges and face, as `TriangleTree.normals` describes them."""
    faces, face = np.asarray(mesh.faces), np.asarray(mesh.face_normals, dtype=np.float64)
    vertex = np.zeros((len(mesh.vertices), 3))
    np.add.at(vertex, faces, mesh.face_angles[:, :, None] * face[:, None])
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1)  # ab, bc, ca
    _, which = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    which = which.reshape(-1, 3)
    edge = np.zeros((which.max() + 1, 3))
    np.add.at(edge, which, np.broadcast_to(face[:, None], (*which.shape, 3)))
    return np.concatenate([vertex[faces], edge[which], face[:, None]], axis=1)


@njit(cache=True, nogil=True)
@no_type_check
def signed_distances(tree, points):
    """Signed distances (k,) [m] of points (k, 3) to the union of the bodies, and their gradients (k, 3).

    A body's sign is that of the side its nearest feature's normal points to; the union takes the least of all.
    """
    distance, gradient = np.empty(len(points)), np.empty((len(points), 3))
    far = np.empty(len(tree.root))
    for i in range(len(points)):
        p = points[i]
        nearest = 0
        for b in range(len(far)):
            far[b] = _box_square(tree, tree.root[b], p)
            if far[b] < far[nearest]:
                nearest = b
        best = np.inf
        for turn in range(-1, len(far)):
            b = nearest if turn < 0 else turn
            outside = tree.closed[b] and far[b] > 0.0
            if turn == nearest or (outside and (best <= 0.0 or far[b] >= best * best)):
                continue
            bound = best * best if outside else np.inf
            square, triangle, feature, x, y, z = _search(tree, tree.root[b], p, bound)
            if triangle < 0:
                continue
            normal = tree.normals[triangle, feature]
            x, y, z = p[0] - x, p[1] - y, p[2] - z
            sign = -1.0 if x * normal[0] + y * normal[1] + z * normal[2] < 0.0 else 1.0
            length = np.sqrt(square)
            if sign * length < best:
                best = sign * length
                if length < 1e-12:  # on the surface
                    x, y, z = normal[0], normal[1], normal[2]
                    sign, length = 1.0, np.sqrt(x * x + y * y + z * z)
                scale = sign / length
                gradient[i, 0], gradient[i, 1], gradient[i, 2] = scale * x, scale * y, scale * z
        distance[i] = best
    return distance, gradient


@njit(cache=True, nogil=True)
@no_type_check
def _search(tree, root, p, bound):
    """Square distance below `bound` of p to a body, the triangle, its feature and the nearest point; -1 for none."""
    stack, waiting = np.empty(DEEPEST, np.int64), 1
    stack[0] = root
    found, feature, x, y, z = -1, 6, 0.0, 0.0, 0.0
    while waiting > 0:
        waiting -= 1
        node = stack[waiting]
        if _box_square(tree, node, p) >= bound:
            continue
        if tree.held[node] == 0:
            left, right = node + 1, tree.right[node]
            if _box_square(tree, left, p) < _box_square(tree, right, p):
                left, right = right, left
            stack[waiting], stack[waiting + 1] = left, right  # the nearer one is taken up first
            waiting += 2
            continue
        for t in range(tree.first[node], tree.first[node] + tree.held[node]):
            cx, cy, cz, at = _closest(tree.corners[t], p)
            square = (p[0] - cx) ** 2 + (p[1] - cy) ** 2 + (p[2] - cz) ** 2
            if square < bound:
                bound, found, feature, x, y, z = square, t, at, cx, cy, cz
    return bound, found, feature, x, y, z


@njit(cache=True, nogil=True)
@no_type_check
def _box_square(tree, node, p):
    """Square distance of p to a node's box; 0 inside."""
    square = 0.0
    for axis in range(3):
        if p[axis] < tree.lower[node, axis]:
            square += (tree.lower[node, axis] - p[axis]) ** 2
        elif p[axis] > tree.upper[node, axis]:
            square += (p[axis] - tree.upper[node, axis]) ** 2
    return square


@njit(cache=True, nogil=True)
@no_type_check
def _closest(corners, p):
    """Nearest point of a triangle and the feature it lies on (Ericson, Real-Time Collision Detection, 5.1.5)."""
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for k in range(3):
        ab, ac = corners[1, k] - corners[0, k], corners[2, k] - corners[0, k]
        d1 += ab * (p[k] - corners[0, k])
        d2 += ac * (p[k] - corners[0, k])
        d3 += ab * (p[k] - corners[1, k])
        d4 += ac * (p[k] - corners[1, k])
        d5 += ab * (p[k] - corners[2, k])
        d6 += ac * (p[k] - corners[2, k])
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        v, w, feature = 0.0, 0.0, 0
    elif d3 >= 0.0 and d4 <= d3:
        v, w, feature = 1.0, 0.0, 1
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w, feature = d1 / (d1 - d3), 0.0, 3
    elif d6 >= 0.0 and d5 <= d6:
        v, w, feature = 0.0, 1.0, 2
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w, feature = 0.0, d2 / (d2 - d6), 5
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v, feature = 1.0 - w, 4
    else:
        v, w, feature = vb / (va + vb + vc), vc / (va + vb + vc), 6
    u = 1.0 - v - w
    x = u * corners[0, 0] + v * corners[1, 0] + w * corners[2, 0]
    y = u * corners[0, 1] + v * corners[1, 1] + w * corners[2, 1]
    z = u * corners[0, 2] + v * corners[1, 2] + w * corners[2, 2]
    return x, y, z, feature
