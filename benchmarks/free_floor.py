"""Where a robot fits in a scene of any kind, by the physics' own shapes, and the shortest way between two places."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import pybullet
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from robots.simulation import Scene, World

REACH = 0.6
"""Clearances are measured up to here [m]."""


@dataclass(frozen=True)
class FreeFloor:
    """Clearance of an upright cylinder over a grid of places.

    Attributes:
        low: (2,) place of the first cell [m].
        spacing: of the cells [m].
        clearance: (nx, ny) gap between the cylinder and anything [m], at most `REACH`; negative where it does not fit.
    """

    low: np.ndarray
    spacing: float
    clearance: np.ndarray

    @staticmethod
    def of(
        scene: Scene, radius: float, spacing: float = 0.1, heights: tuple[float, float] = (0.06, 1.3)
    ) -> FreeFloor:
        """Measure a scene with a cylinder of `radius` [m] between two heights [m]."""
        with World(scene) as world:
            client = world.client
            bodies = [pybullet.getBodyUniqueId(i, client) for i in range(pybullet.getNumBodies(client))]
            low, high = _extent(client, bodies)
            shape = pybullet.createCollisionShape(
                pybullet.GEOM_CYLINDER, radius=radius, height=heights[1] - heights[0], physicsClientId=client
            )
            probe = pybullet.createMultiBody(0, shape, physicsClientId=client)
            counts = np.ceil((high - low)[:2] / spacing).astype(int)
            clearance = np.full(counts, REACH)
            for i, j in np.ndindex(*counts):
                at = [*(low[:2] + spacing * np.array([i, j])), sum(heights) / 2]
                pybullet.resetBasePositionAndOrientation(probe, at, [0, 0, 0, 1], physicsClientId=client)
                clearance[i, j] = min([_gap(client, probe, body, heights[0]) for body in bodies] + [REACH])
        return FreeFloor(low[:2], spacing, clearance)

    def places(self, clearance: float) -> np.ndarray:
        """The places (n, 2) [m] of the largest joined region with a clearance [m]; cells of the rim are outside."""
        free = self.clearance >= clearance
        labels, count = ndimage.label(free)
        sizes = ndimage.sum_labels(free, labels, range(1, count + 1))
        outside = {int(v) for edge in (labels[0], labels[-1], labels[:, 0], labels[:, -1]) for v in edge}
        order = [k for k in np.argsort(-np.asarray(sizes)) + 1 if k not in outside]
        if not order:
            return np.empty((0, 2))
        return self.low + self.spacing * np.argwhere(labels == order[0])

    def shortest(self, start: np.ndarray, goal: np.ndarray) -> float:
        """Length [m] of the shortest way on which the cylinder fits; inf if there is none."""
        graph = self._graph
        a, b = (self._cell(place) for place in (start, goal))
        return float(dijkstra(graph, indices=a)[b])

    def _cell(self, place: np.ndarray) -> int:
        i, j = np.round((np.asarray(place) - self.low) / self.spacing).astype(int)
        return int(i * self.clearance.shape[1] + j)

    @functools.cached_property
    def _graph(self) -> coo_array:
        """Sixteen neighbours a cell: ways are at most 3 % longer than straight ones."""
        free, index = self.clearance >= 0, np.arange(self.clearance.size).reshape(self.clearance.shape)
        nx, ny = free.shape
        rows, columns, lengths = [], [], []
        for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (2, -1), (1, 2), (1, -2)):
            here = index[: nx - di, max(0, -dj) : ny - max(0, dj)].ravel()
            there = index[di:, max(0, dj) : ny + min(0, dj)].ravel()
            joined = free.flat[here] & free.flat[there]
            rows += [here[joined], there[joined]]
            columns += [there[joined], here[joined]]
            lengths += [np.full(2 * int(joined.sum()), self.spacing * np.hypot(di, dj))]
        entries = (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns)))
        return coo_array(entries, shape=(free.size, free.size)).tocsr()


def _extent(client: int, bodies: list[int]) -> tuple[np.ndarray, np.ndarray]:
    boxes = [
        pybullet.getAABB(body, link, physicsClientId=client)
        for body in bodies
        for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client))
    ]
    return np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)


def _gap(client: int, probe: int, body: int, low: float) -> float:
    """Distance [m] to what stands higher than `low` [m]: floors and rugs are no obstacles."""
    points = pybullet.getClosestPoints(probe, body, REACH, physicsClientId=client)
    return min((float(point[8]) for point in points if point[6][2] > low - 1e-3), default=REACH)
