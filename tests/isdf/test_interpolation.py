"""Creases: half way between two surfaces the field follows both of them, not the chord across."""

import math

import numpy as np
import pytest
import torch
from numba import njit
from scipy.interpolate import RegularGridInterpolator

from isdf import Mapper, PinholeCamera
from isdf.mapping.field import LatticeField
from isdf.mapping.interpolation import (
    BEND,
    LIFT,
    PARTS,
    THINNEST,
    crease,
    creased,
    fine_nodes,
    may_have_crease,
)
from isdf.mapping.lately import Lately
from isdf.mapping.lattice import CHUNK, FINE, STEP, UNIT
from tests.isdf.rooms import box, furnished_orbit, inside_of, look_at, mapped, render

GRID = np.stack(np.meshgrid(*[np.arange(-1.0, 3.0)] * 3, indexing="ij"), axis=-1)


def room_to_work_in():
    return np.empty((4, 4, 2), dtype=np.float32), np.empty((4, 3), dtype=np.float32)


def at(values, place, apart=1.0):
    x, y, z = (np.float32(p) for p in place)
    return creased(values.astype(np.float32), x, y, z, np.float32(apart), *room_to_work_in())


def two_planes(seed):
    """Unit normals of two planes that pass near the middle of the cell in the middle.

    With their heights at the nodes (4, 4, 4, 2), and places in the cell (20, 3) with the heights there (20, 2).
    """
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(2, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets, places = 0.3 * rng.normal(size=2), rng.random((20, 3))
    return normals, (GRID - 0.5) @ normals.T + offsets, places, (places - 0.5) @ normals.T + offsets


# Far enough inside of solids, or outside of them, that the sides of two planes do not matter.
DEEP, FAR = -5.0, 5.0


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("least", [True, False], ids=["ridge", "valley"])
def test_the_crease_of_two_planes_is_met_exactly(seed, least):
    """In free space it is the lower of both that holds, inside of solids the higher."""
    normals, values, places, heights = two_planes(seed)
    values = values.min(axis=-1) + FAR if least else values.max(axis=-1) + DEEP
    for place, each in zip(places, heights, strict=True):
        value, *gradient = at(values, place)
        assert value == pytest.approx(each.min() + FAR if least else each.max() + DEEP, abs=1e-5)
        if abs(each[0] - each[1]) > 1e-3:
            holds = each.argmin() if least else each.argmax()
            assert gradient == pytest.approx(normals[holds], abs=1e-4)


@pytest.mark.parametrize("seed", range(20))
def test_a_board_between_the_nodes_is_met_exactly(seed):
    """Nodes 4 cm apart, on the axis closest to its normal none inside of a board 2 cm thick."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    places = rng.random((50, 3))
    heights, values = 0.04 * (places - 0.5) @ normal, 0.04 * (GRID - 0.5) @ normal
    inside = 0
    for place, height in zip(places, heights, strict=True):
        value, *gradient = at(np.abs(values) - 0.01, place, apart=0.04)
        assert value == pytest.approx(abs(height) - 0.01, abs=1e-5)
        if abs(height) > 1e-4:
            assert gradient == pytest.approx(0.04 * np.sign(height) * normal, abs=1e-5)
        inside += value < 0
    assert inside > 5


def test_as_a_board_vanishes_the_field_rises_to_the_chord_without_a_jump():
    depths, step = np.arange(-0.01, 0.01, 1e-4), 0.04
    middle = []
    for depth in depths:
        row = [np.float32(step * abs(n - 0.5) + depth) for n in range(-1, 3)]
        n, t, lift = crease(*row, np.float32(0.5), np.float32(step))
        middle.append(row[n] + t * (row[n + 1] - row[n]) + lift)
    middle = np.array(middle)
    board = depths < -THINNEST / 2
    assert middle[board] == pytest.approx(depths[board], abs=1e-6)
    assert middle[depths > 0] == pytest.approx(step / 2 + depths[depths > 0], abs=1e-6)
    assert (np.diff(middle) > 0).all() and np.diff(middle).max() < (LIFT + 1.01) * 1e-4


def trilinear(corners, place):
    weights = [np.array([1 - p, p]) for p in place]
    return np.einsum("abc,a,b,c->", corners, *weights)


@pytest.mark.parametrize("seed", range(20))
def test_where_values_bend_up_outside_of_solids_it_is_trilinear(seed):
    """As beside the edges of things, where distances are round."""
    values = two_planes(seed)[1].max(axis=-1) + FAR
    for place in two_planes(seed)[2]:
        assert at(values, place)[0] == pytest.approx(trilinear(values[1:3, 1:3, 1:3], place), abs=1e-5)


@pytest.mark.parametrize("way", [1, -1], ids=["ridge", "valley"])
def test_where_distances_jump_nothing_is_extended(way):
    """As from what is known to be solid to what is not: a line through both would run far off."""
    row = way * np.array([-2.0, 0.0, 0.0, -1.0])
    values = np.broadcast_to(row, (4, 4, 4)) + way * FAR
    assert at(values, (0.3, 0.6, 0.5))[0] == pytest.approx(way * FAR, abs=1e-5)
    row[0] = -1.0 * way
    values = np.broadcast_to(row, (4, 4, 4)) + way * FAR
    assert at(values, (0.3, 0.6, 0.5))[0] == pytest.approx(way * (FAR + 0.5), abs=1e-5)


@pytest.mark.parametrize("axis", range(3))
def test_it_is_continuous_from_cell_to_cell(axis):
    rng = np.random.default_rng(axis)
    for _ in range(20):
        values = rng.random((5, 5, 5)) - 0.5
        below, above = np.delete(values, 4, axis=axis), np.delete(values, 0, axis=axis)
        for other in {0, 1, 2} - {axis}:
            below, above = np.delete(below, 4, axis=other), np.delete(above, 4, axis=other)
        place = rng.random(3)
        place[axis] = 1
        end = at(below, place)[0]
        place[axis] = 0
        assert end == pytest.approx(at(above, place)[0], abs=1e-5)


@pytest.fixture(scope="module")
def orbit():
    return mapped(furnished_orbit(16))


def lattice_of(mapper):
    """Coarse values and rows of corrections as dense arrays, and the corrections."""
    lattice, begin = mapper.lattice, np.zeros(3, dtype=int)
    end = np.array(lattice.shape)
    return UNIT * lattice.read("value", begin, end), lattice.read("block", begin, end), lattice.corrections


def fine_value(value, block, corrections, cell, node):
    """Value of fine node (3,) of a cell, by the definition."""
    i, j, k = cell
    out = trilinear(value[i : i + 2, j : j + 2, k : k + 2], np.asarray(node) / PARTS)
    if block[cell] >= 0:
        out += STEP * corrections[block[cell]].reshape(FINE, FINE, FINE)[tuple(node)]
    return out


def test_fine_nodes_are_those_of_the_cell_and_of_those_beside_it(orbit):
    lattice = orbit.lattice
    value, block, corrections = lattice_of(orbit)
    rng, out = np.random.default_rng(0), np.empty((4, 4, 4), dtype=np.float32)
    room = np.empty((3, 3, 4), np.float32), np.empty((3, 4, 4), np.float32), np.empty((2, 2, 2), np.int32)
    arrays = lattice.table, lattice.nodes.arrays["value"], lattice.nodes.arrays["block"], corrections
    inner = np.argwhere(block[1:-2, 1:-2, 1:-2] >= 0) + 1
    for cell in rng.permutation(inner)[:150]:
        part = rng.integers(0, PARTS, 3)
        fine_nodes(*arrays, tuple(cell), tuple(part), *room, out)
        for index in np.ndindex(4, 4, 4):
            node = part - 1 + np.array(index)
            # Nodes outside belong to the next cell, those on the rim to this one.
            beside = np.where(node < 0, -1, np.where(node > PARTS, 1, 0))
            expected = fine_value(value, block, corrections, tuple(cell + beside), node - PARTS * beside)
            assert out[index] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("corner", list(np.ndindex(2, 2, 2)))
def test_at_the_end_of_the_lattice_nothing_beyond_is_read(corner):
    """One refined cell in a corner of a lattice of one chunk: no row of corrections follows its own."""
    cell = tuple((CHUNK - 2) * c for c in corner)
    value, block = np.zeros((1, CHUNK**3), np.int16), np.full((1, CHUNK**3), -1, np.int32)
    block.reshape(CHUNK, CHUNK, CHUNK)[cell] = 0
    corrections = np.zeros((1, FINE**3), np.int8)
    corrections[0, :: FINE // 2] = 50
    seen = np.zeros((1, CHUNK**3), np.uint8)
    field = LatticeField(
        np.zeros((1, 1, 1), np.int32), value, seen, block, corrections, seen, np.zeros(3, int), 1.0,
        torch.tensor([[0.0] * 3, [7.0] * 3]), Lately.of(np.zeros((0, 3), int), 1.0),
    )  # fmt: skip
    inside = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    expected = RegularGridInterpolator(
        (np.arange(FINE) / PARTS,) * 3, STEP * corrections.reshape(FINE, FINE, FINE)
    )(inside.numpy())
    distance = field.distance(inside + torch.tensor(cell))
    torch.testing.assert_close(distance, torch.from_numpy(expected).float(), atol=1e-5, rtol=0)


@njit(nogil=True, cache=True)
def asked(corrections, a, b, c, way):
    return may_have_crease(corrections, 0, a, b, c, way)


def bends(block, cell):
    """Whether both ends of any edge of a fine cell bend down by more than `BEND`; its rim may by what lies beyond."""
    for axis in range(3):
        turned = np.moveaxis(block, axis, 0)
        place = np.array(cell)[[axis, *[other for other in range(3) if other != axis]]]
        n = place[0]
        for u, v in np.ndindex(2, 2):
            row = turned[:, place[1] + u, place[2] + v]
            low = n == 0 or 2 * row[n] - row[n - 1] - row[n + 1] > BEND
            high = n == PARTS - 1 or 2 * row[n + 1] - row[n] - row[n + 2] > BEND
            if low and high:
                return True
    return False


@pytest.mark.parametrize("way", [1, -1], ids=["down", "up"])
def test_only_where_values_bend_are_neighbours_asked(way):
    rng, found = np.random.default_rng(0), 0
    for _ in range(60):
        block = rng.integers(-2, 3, (FINE, FINE, FINE))
        for cell in np.ndindex(PARTS, PARTS, PARTS):
            expected = bends(way * block, cell)
            assert asked(block.reshape(1, -1).astype(np.int8), *cell, way) == expected
            found += expected
    assert 200 < found < 60 * PARTS**3 - 200


def test_between_two_walls_the_gradient_turns_at_once():
    """A corridor whose middle lies between two fine nodes."""
    sdf, mapper = inside_of(box((0.0, 0.017, 1.25), (6.0, 1.6, 2.5))), Mapper()
    camera = PinholeCamera.from_fov(160, 120, math.radians(80))
    for n, y in enumerate((-0.6, 0.0, 0.6)):
        mapper.integrate(render(sdf, look_at((-1.5, 0.0, 1.2), (2.0, y, 1.2)), camera, 0.1 * n))
    mapper.refresh()
    across = torch.linspace(-0.04, 0.04, 33)
    points = torch.stack([torch.full_like(across, 0.5), 0.017 + across, torch.full_like(across, 1.2)], dim=1)
    distance, gradient = mapper.field().distance_and_gradient(points)
    away = across.abs() > 0.012
    assert (gradient[away, 1].sign() == -across[away].sign()).all()
    assert (gradient[away, 1].abs() > 0.9).all()
    assert (distance - (0.8 - across.abs())).abs().max() < 0.012
