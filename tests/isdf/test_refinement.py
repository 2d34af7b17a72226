"""Distances of a window by short cuts, against what they stand for."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from isdf import Mapper
from isdf.mapping import refresh
from isdf.mapping.evidence import FREE, bounds
from isdf.mapping.lattice import BLOCK, FINE, STEP
from isdf.mapping.nearest import finer_nearest, nearest_points
from isdf.mapping.patches import MOST, NODES, cell_place, nearest_of, patch_at, patches_about
from isdf.mapping.refinement import cells_to_refine, middle_values, near_known, refined_values
from tests.isdf.rooms import furnished_orbit


@pytest.fixture(scope="module")
def refreshed():
    """Arguments of the last `refined_values` of a mapper that saw half of a room: window, patches, bricks."""
    kept = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(
            refresh, "refined_values", lambda *arguments: kept.append(arguments) or refined_values(*arguments)
        )
        mapper = Mapper()
        for frame in furnished_orbit(16)[:6]:
            mapper.integrate(frame)
        mapper.refresh()
    return kept[-1][:3]


def nodes_of(shape):
    return np.argwhere(np.ones(shape, dtype=bool))


def distances(points, number, nodes):
    return np.linalg.norm(points[number.ravel()] - nodes, axis=1)


def wavy(seed, count=3000):
    """Points of a surface through a box of 32 x 28 x 24 nodes, and a layer of nodes about it."""
    rng = np.random.default_rng(seed)
    across = rng.random((count, 2)) * [31, 27]
    height = 10 + 4 * np.sin(0.2 * across[:, 0] + seed) + 3 * np.cos(0.3 * across[:, 1])
    points = np.column_stack([across, height]).astype(np.float32)
    away = cKDTree(points).query(nodes_of((33, 29, 25)))[0].reshape(33, 29, 25)
    return points, away, away < 6


def swept(points, where):
    """Numbers of the nearest points of nodes, one node and one neighbour after the other."""
    number, square = np.full(where.shape, -1), np.full(where.shape, np.inf, dtype=np.float32)

    def offer(n, node):
        away = points[n] - np.array(node, dtype=np.float32)
        d = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
        if d < square[node]:
            number[node], square[node] = n, d

    last = np.array(where.shape) - 1
    for n, point in enumerate(np.floor(points).astype(int)):
        for node in {tuple(np.clip(point + step, 0, last)) for step in np.ndindex(2, 2, 2)}:
            offer(n, node)
    before = [step for step in np.ndindex(3, 3, 3) if step < (1, 1, 1)]
    nodes = [node for node in np.ndindex(*where.shape) if where[node]]
    for order, way in ((nodes, 1), (nodes[::-1], -1)):
        for node in order:
            for step in before:
                other = tuple(np.array(node) + way * (np.array(step) - 1))
                if min(other) >= 0 and (np.array(other) <= last).all() and number[other] >= 0:
                    offer(number[other], node)
    return number, square


@pytest.mark.parametrize("seed", range(6))
def test_rows_swept_at_once_give_what_nodes_one_after_the_other_give(seed):
    rng = np.random.default_rng(seed)
    shape = np.array([5, 7, 12])
    where = rng.random(shape) < (0.1, 0.3, 0.5, 0.8, 0.95, 1.0)[seed]
    points = (rng.random((8, 3)) * (shape + 3) - 2).astype(np.float32)
    number, square = nearest_points(points, where)
    expected, least = swept(points, where)
    assert np.array_equal(number, expected)
    assert np.array_equal(square[number >= 0], least[number >= 0])


@pytest.mark.parametrize("seed", range(3))
def test_a_mask_changes_nothing_of_what_is_asked_for(seed):
    points, away, where = wavy(seed)
    nodes = nodes_of(where.shape)[where.ravel()]
    coarse, _ = nearest_points(points / 2, np.ones((17, 15, 13), dtype=bool))
    masked, square = nearest_points(points, where)
    everywhere, _ = nearest_points(points, np.ones_like(where))
    for number in (masked, everywhere, finer_nearest(points, coarse, where)):
        over = distances(points, number[where], nodes) - away[where]
        assert over.min() > -1e-4 and over.mean() < 0.03 and np.quantile(over, 0.99) < 0.3
    np.testing.assert_allclose(
        np.sqrt(square[where]), distances(points, masked[where], nodes), rtol=1e-4, atol=1e-4
    )
    assert (masked == everywhere)[where].mean() > 0.97


def test_coarser_nodes_outside_the_mask_keep_their_points():
    points, away, _ = wavy(0)
    coarse, _ = nearest_points(points / 2, np.ones((17, 15, 13), dtype=bool))
    finer = finer_nearest(points, coarse, np.zeros(away.shape, dtype=bool))[::2, ::2, ::2]
    over = distances(points, finer, 2 * nodes_of(coarse.shape)) - away[::2, ::2, ::2].ravel()
    assert over.min() > -1e-4 and over.mean() < 0.1
    assert np.quantile(over[away[::2, ::2, ::2].ravel() < 1], 0.99) < 1e-4


@pytest.mark.parametrize("seed", range(4))
def test_lower_bounds_are_distances_to_the_border_of_what_was_looked_through(seed):
    noise = np.random.default_rng(seed).normal(size=(26, 24, 18))
    free = gaussian_filter(noise, 3) > 0
    seeds = np.array([[99, 99, 99]], dtype=np.float32)  # so far that it bounds nothing
    proven = bounds(seeds, np.where(free, FREE, 0).astype(np.uint8), np.zeros(3), 1.0)
    for these, those, sign in ((free, ~free, 1), (~free, free, -1)):
        exact = sign * (cKDTree(np.argwhere(those)).query(np.argwhere(these))[0] - 0.5)
        off = np.abs(proven.lower[these] - exact)
        assert off.mean() < 4e-3 and off.max() < 0.6


def test_only_near_what_is_known_can_a_cell_be_refined(refreshed):
    window, _, bricks = refreshed
    where, known = near_known(window, bricks), window.state != 0
    assert 0.1 < known.mean() < 0.9
    expected = np.zeros_like(where)
    for i, j, k in np.argwhere(known):
        expected[
            max(0, 2 * i - 2) : 2 * i + 3, max(0, 2 * j - 2) : 2 * j + 3, max(0, 2 * k - 2) : 2 * k + 3
        ] = 1
    assert where[expected > 0].all() and where.mean() < 1.1 * expected.mean()


def refinement(window, line, miss, corrections):
    refine, stale = np.zeros(window.block.shape, dtype=bool), np.zeros(window.block.shape, dtype=bool)
    cells_to_refine(window, line, miss, corrections, refine, stale)
    return refine, stale


def test_middles_are_interpolated_as_the_field_does(refreshed):
    window, patches, bricks = refreshed
    where = near_known(window, bricks)
    line, miss = middle_values(window, patches, bricks, where)
    axes = [np.arange(0, 2 * n, 2) for n in window.value.shape]
    exact = RegularGridInterpolator(axes, window.value)(nodes_of(where.shape)).reshape(where.shape)
    np.testing.assert_allclose(line[where], exact[where], atol=1e-5)
    assert (miss[::2, ::2, ::2] == 0).all() and (line[~where] == 0).all()


def test_what_is_stored_of_a_cell_is_what_its_middles_miss(refreshed):
    """Free corners, others, and guesses on both: all are interpolated alike for a check and for what is written."""
    window, patches, bricks = refreshed
    line, miss = middle_values(window, patches, bricks, near_known(window, bricks))
    window = window._replace(block=np.full_like(window.block, -1))
    corrections = np.zeros((0, BLOCK), dtype=np.int8)
    refine, stale = refinement(window, line, miss, corrections)
    cells = np.argwhere(refine)
    assert len(cells) > 1000 and not stale.any()
    window.block[refine] = np.arange(len(cells))
    corrections = np.zeros((len(cells), BLOCK), dtype=np.int8)
    assert refinement(window, line, miss, corrections)[1][refine].all()
    refined_values(window, patches, bricks, miss, cells, corrections)
    again, stale = refinement(window, line, miss, corrections)
    assert np.array_equal(again, refine) and stale.sum() < 0.01 * len(
        cells
    )  # those that miss more than can be stored
    stored = STEP * corrections.reshape(-1, FINE, FINE, FINE)[:, ::2, ::2, ::2].astype(float)
    for offset in np.ndindex(3, 3, 3):
        missed = np.clip(miss[tuple((2 * cells + offset).T)], -127 * STEP, 127 * STEP)
        assert np.abs(stored[(slice(None), *offset)] - missed).max() < 0.51 * STEP


def test_a_mask_changes_nothing_of_what_is_refined(refreshed):
    window, patches, bricks = refreshed
    where = near_known(window, bricks)
    line, miss = middle_values(window, patches, bricks, where)
    full = middle_values(
        window, patches._replace(nearest=np.maximum(patches.nearest, 0)), bricks, where | True
    )
    window = window._replace(block=np.full_like(window.block, -1))
    none = np.zeros((0, BLOCK), dtype=np.int8)
    np.testing.assert_array_equal(refinement(window, line, miss, none)[0], refinement(window, *full, none)[0])


def to_discs(discs, places):
    """Distances (n, m) of places (n, 3) to discs (m, 8), and heights above their planes."""
    away = places[:, None] - discs[None, :, :3]
    height = (away * discs[:, 3:6]).sum(axis=2)
    across = np.sqrt(np.maximum(0, (away**2).sum(axis=2) - height**2)) - discs[:, 7]
    return np.hypot(np.maximum(0, across), height), height


def test_the_patch_at_a_node_is_told_from_there(refreshed):
    window, patches, bricks = refreshed
    rng = np.random.default_rng(0)
    for at in rng.choice(np.argwhere(near_known(window, bricks)), 300):
        place = window.step * (window.first * window.ratio + at * window.ratio / 2)
        number = patches.nearest[tuple(at)]
        exact, height = to_discs(patches.discs[[number]], place[None])
        distance, side, weight = patch_at(window, patches, tuple(at.tolist()))
        assert distance == pytest.approx(exact[0, 0], abs=1e-4)
        assert side == pytest.approx(height[0, 0], abs=1e-4) and weight == patches.discs[number, 6]


def refined_cells(refreshed, count):
    """Cells to refine, and of each the distances to discs and their numbers at its fine nodes, and the nodes [m]."""
    window, patches, bricks = refreshed
    line, miss = middle_values(window, patches, bricks, near_known(window, bricks))
    refine, _ = refinement(
        window._replace(block=np.full_like(window.block, -1)), line, miss, np.zeros((0, BLOCK), dtype=np.int8)
    )
    chosen, which = np.empty(MOST, dtype=np.int32), np.zeros(BLOCK, dtype=np.int32)
    distance, offsets = np.empty(BLOCK, dtype=np.float32), np.float32(window.step) * NODES
    for cell in np.random.default_rng(0).permutation(np.argwhere(refine))[:count].tolist():
        found = patches_about(window, patches, *cell, chosen)
        place = cell_place(window, *cell)
        nearest_of(patches.discs, chosen[:found], place, offsets, distance, which)
        yield cell, distance.copy(), which.copy(), np.array(place) + offsets.T


def test_a_cell_knows_the_nearest_of_all_patches_close_to_a_surface(refreshed):
    """With only those nearest to every second node, a third of the distances were wrong by more than a centimetre."""
    discs, errors = refreshed[1].discs, []
    for _, distance, which, places in refined_cells(refreshed, 250):
        near = np.linalg.norm(discs[:, :3] - places.mean(axis=0), axis=1) < 0.3
        if not near.any():
            continue
        exact, _ = to_discs(discs[near], places)
        close = exact.min(axis=1) < 0.04
        errors.append(distance[close] - exact.min(axis=1)[close])
        own, _ = to_discs(discs[which], places)
        np.testing.assert_allclose(np.diagonal(own), distance, atol=1e-4)
    errors = np.concatenate(errors)
    assert len(errors) > 2000 and errors.min() > -1e-4
    assert (errors > 0.001).mean() < 0.01


def test_neighbouring_cells_agree_on_the_nodes_that_they_share(refreshed):
    found = {
        tuple(cell): distance.reshape(FINE, FINE, FINE)
        for cell, distance, _, _ in refined_cells(refreshed, 9999)
    }
    apart = [
        np.abs(distance[-1] - found[i + 1, j, k][0])
        for (i, j, k), distance in found.items()
        if (i + 1, j, k) in found
    ]
    assert len(apart) > 100
    assert np.quantile(apart, 0.95) < STEP and np.quantile(apart, 0.99) < 0.007
