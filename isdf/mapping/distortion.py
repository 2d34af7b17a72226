"""The depth camera's own low-frequency distortion, learned from walls that it sees from several places.

Depth cameras measure a little too far in one part of the image and too near in another, the same in every image:
about a hundredth (Teichman, Miller and Thrun, RSS 2013; the noise model of Choi et al., CVPR 2015). Two views of one
plane through different parts of the image disagree by the difference, so that linear least squares over many pairs of
views find it. Poses err, too: what a small motion of one of the views explains as well is not laid to the camera.
"""

from __future__ import annotations

import functools
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from .facets import Facets
from .motion import apart

# Products of Legendre polynomials across and down the image, up to this degree together. None is constant: depth that
# is too long everywhere cannot be told from poses that are too close together.
DEGREE = 6
POWERS = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j > 0]
TERMS = len(POWERS)
# A view is kept to compare others with when it was taken so far from the last one [m, rad]; so many are.
APART, TURNED, KEPT = 0.2, 0.25, 12
# Planes of two views are one if their normals agree to this cosine and they are no farther apart than this [m], plus
# so much times the squared depth.
PARALLEL, GAP, GAP_NOISE = 0.95, 0.02, 0.015
# Standard deviation of the distance of two measured planes [m], plus so much times the squared depth. Squares of one
# image err together: a pair of views counts as much as SHARE of its squares would alone.
SIGMA, SIGMA_NOISE, SHARE = 0.004, 0.003, 0.1
# Every so many of a view's squares are compared.
THINNED = 2
# Standard deviation of a pose [rad, m].
ROTATION, TRANSLATION = 0.005, 0.01


class Key(NamedTuple):
    """A camera: its image size and intrinsics. Another one has another distortion."""

    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]


class Distortion:
    """Estimates the relative depth error of a camera, and frees depth images of it.

    Args:
        sigma: standard deviation of the relative error that is expected before anything is known; 0 learns nothing.

    Attributes:
        key: which camera it belongs to; None before the first image.
        information: (TERMS, TERMS) of the coefficients, from all pairs so far.
        vector: (TERMS,) `information` times their estimate by these pairs alone.
    """

    def __init__(self, sigma: float) -> None:
        self.sigma = sigma
        self.key: Key | None = None
        self._begin()

    def _begin(self) -> None:
        self.information, self.vector = np.zeros((TERMS, TERMS)), np.zeros(TERMS)
        self._views: list[Facets] = []
        self._turn = 0
        self._factor: Float[np.ndarray, "h w"] | None = None

    def restore(
        self,
        key: Key | None,
        information: Float[np.ndarray, "terms terms"],
        vector: Float[np.ndarray, "terms"],
    ) -> None:
        """Go on from an earlier estimate, with new views; ValueError where the arrays are none."""
        fits = information.shape == (TERMS, TERMS) and vector.shape == (TERMS,)
        if not (fits and np.isfinite(information).all() and np.isfinite(vector).all()):
            raise ValueError(
                f"the camera's distortion is of shape {information.shape}, {vector.shape} or not finite"
            )
        self._begin()
        self.key, self.information, self.vector = key, information.astype(float), vector.astype(float)

    @property
    def coefficients(self) -> Float[np.ndarray, "terms"]:
        """The most probable coefficients of the polynomials in `POWERS`."""
        if self.sigma == 0:
            return np.zeros(TERMS)
        # Smooth errors are more probable; together they have the variance sigma^2.
        share = np.array([1.0 / (i + j) ** 2 for i, j in POWERS])
        prior = np.diag(share.sum() / (self.sigma**2 * share))
        return np.linalg.solve(self.information + prior, self.vector)

    def relative(self, height: int, width: int) -> Float[np.ndarray, "height width"]:
        """How much too far the camera measures at every pixel, as a share of the depth."""
        weights = np.zeros((DEGREE + 1, DEGREE + 1))
        weights[tuple(np.transpose(POWERS))] = self.coefficients
        return np.asarray(_image(polynomials(height), weights.T, polynomials(width)))

    def correct(
        self, depth: Float[np.ndarray, "h w"], intrinsics: tuple[float, float, float, float]
    ) -> Float[np.ndarray, "h w"]:
        """A measured depth image [m] without the distortion as it is known so far; another camera's starts anew."""
        key = Key((depth.shape[0], depth.shape[1]), intrinsics)
        if key != self.key:
            self._begin()
            self.key = key
        if not self.information.any():
            return depth
        if self._factor is None:
            self._factor = (1 / (1 + self.relative(*key.size))).astype(np.float32)
        return np.asarray(depth * self._factor)

    def learn(
        self,
        depth: Float[np.ndarray, "h w"],
        intrinsics: tuple[float, float, float, float],
        T: Float[np.ndarray, "4 4"],
    ) -> None:
        """Compare a depth image [m] as it was measured, from pose T_world_camera, with one of the views kept."""
        if self.sigma == 0:
            return
        view = Facets.of(depth, intrinsics, T)
        if self._views:
            self._turn = (self._turn + 1) % len(self._views)
            other = self._views[self._turn]
            self._add(view, other)
            self._factor = None
        moved, turned = apart(self._views[-1].pose, T) if self._views else (np.inf, np.inf)
        if moved > APART or turned > TURNED:
            self._views = [*self._views, view][-KEPT:]

    def _add(self, view: Facets, other: Facets) -> None:
        products = _products(compare(view, other), self.coefficients)
        # The pose's six numbers are solved for and dropped (Schur complement).
        loose = np.diag(1 / np.array([ROTATION] * 3 + [TRANSLATION] * 3) ** 2 / 2)
        both = products[TERMS:-1, :TERMS]
        gain = np.linalg.solve(products[TERMS:-1, TERMS:-1] + loose, both).T
        self.information += products[:TERMS, :TERMS] - gain @ both
        self.vector += products[:TERMS, -1] - gain @ products[TERMS:-1, -1]


@functools.lru_cache(maxsize=8)
def polynomials(count: int) -> Float[np.ndarray, "count degree"]:
    """Legendre polynomials at the middles of so many equal parts of [-1, 1], each of mean square 1."""
    middles = (2 * np.arange(count) + 1) / count - 1
    return np.polynomial.legendre.legvander(middles, DEGREE) * np.sqrt(2 * np.arange(DEGREE + 1) + 1)


# Matrix products of these sizes are quicker than the threads that numpy would start for them.
@njit(cache=True, nogil=True)
@no_type_check
def _image(down, weights, across):
    """down @ weights @ across.T."""
    left, out = np.zeros((len(down), weights.shape[1])), np.zeros((len(down), len(across)))
    for v in range(len(down)):
        for i in range(weights.shape[0]):
            for j in range(weights.shape[1]):
                left[v, j] += down[v, i] * weights[i, j]
        for u in range(len(across)):
            for j in range(weights.shape[1]):
                out[v, u] += left[v, j] * across[u, j]
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _products(equations, coefficients):
    """Sums of weighted products (m, m) of the columns of the equations (n, m) of `compare`.

    The weights are of a heavy tail (Cauchy): what has moved between the views counts little.
    """
    count, columns = equations.shape
    out = np.zeros((columns, columns))
    for n in range(count):
        row = equations[n]
        residual = row[columns - 1]
        for i in range(len(coefficients)):
            residual -= row[i] * coefficients[i]
        weight = SHARE / (1 + residual * residual / 4)
        for i in range(columns):
            scaled = weight * row[i]
            for j in range(columns):
                out[i, j] += scaled * row[j]
    return out


def compare(view: Facets, other: Facets) -> Float[np.ndarray, "n columns"]:
    """Where two views show one plane: how its two measurements differ, and what that says of the camera.

    Returns:
        An equation a row, in standard deviations. But for noise, the last column is the sum of the first TERMS, times
        the camera's coefficients, and of the next six, times a turn [rad] and a shift [m] of the first view about its
        own camera.
    """
    at = tuple(axis[::THINNED] for axis in np.nonzero(view.flat))
    R, centre = view.pose[:3, :3], view.pose[:3, 3]
    depth = 1 / view.inverse[at]
    ray = view.rays[at] @ R.T
    point = centre + ray * depth[:, None]
    there, seen = _look_up(other, point)
    at, depth, ray, point = (at[0][seen], at[1][seen]), depth[seen], ray[seen], point[seen]
    normal = other.normals[there] @ other.pose[:3, :3].T
    other_depth, other_ray = 1 / other.inverse[there], other.rays[there] @ other.pose[:3, :3].T
    gap = np.einsum("nk,nk->n", point - other.pose[:3, 3] - other_ray * other_depth[:, None], normal)
    far = np.maximum(depth, other_depth) ** 2
    parallel = np.einsum("nk,nk->n", view.normals[at] @ R.T, normal) > PARALLEL
    good = parallel & (np.abs(gap) < GAP + GAP_NOISE * far)
    across = np.einsum("nk,nk->n", ray, normal) * depth
    other_across = np.einsum("nk,nk->n", other_ray, normal) * other_depth
    camera = across[:, None] * _terms(view, at) - other_across[:, None] * _terms(other, there)
    equations = np.column_stack([camera, np.cross(point - centre, normal), normal, gap])[good]
    return equations / (SIGMA + SIGMA_NOISE * far[good])[:, None]


def _look_up(
    view: Facets, points: Float[np.ndarray, "n 3"]
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Row and column of the flat squares that points [m] fall on, and which points those are."""
    local = (points - view.pose[:3, 3]) @ view.pose[:3, :3]
    fx, fy, cx, cy = view.intrinsics
    height, width = view.flat.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        column = np.floor(fx * local[:, 0] / local[:, 2] + cx + 0.5)
        row = np.floor(fy * local[:, 1] / local[:, 2] + cy + 0.5)
    inside = (local[:, 2] > 0) & (row >= 0) & (column >= 0) & (row < height) & (column < width)
    chosen = np.flatnonzero(inside)
    rows, columns = row[chosen].astype(int), column[chosen].astype(int)
    flat = view.flat[rows, columns]
    return (rows[flat], columns[flat]), chosen[flat]


def _terms(view: Facets, at: tuple[np.ndarray, np.ndarray]) -> Float[np.ndarray, "n terms"]:
    """The products of polynomials in the middle of some squares."""
    down, across = (polynomials(n) for n in view.flat.shape)
    i, j = np.transpose(POWERS)
    return across[at[1]][:, i] * down[at[0]][:, j]
