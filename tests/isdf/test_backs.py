"""Boards seen from one side only: how thick they are told by what is seen past their rims."""

import math

import numpy as np
import pytest
import torch

from isdf import Mapper, PinholeCamera
from isdf.mapping.backs import unseen_backs
from isdf.mapping.planes import planes
from isdf.mapping.seeds import surface_seeds
from tests.isdf.rooms import box, inside_of, look_at, render, union

VOXEL = 0.02
# A table top 0.7 to 0.74 m above the floor of a room.
TOP = box((0.0, 0.0, 0.72), (1.0, 0.8, 0.04))


def room(*things):
    return union(inside_of(box((0, 0, 1.25), (5, 4, 2.5))), *things)


def seen_from_above(sdf, around=(0.0, 0.0, 0.7), views=24):
    """A map by a camera that goes around a place, 1 m and 1.6 m up: of what is lower it never sees the underside."""
    camera, mapper = PinholeCamera.from_fov(160, 120, math.radians(60)), Mapper()
    for n in range(views):
        angle = 2 * math.pi * n / views
        eye = (2.0 * math.cos(angle), 1.7 * math.sin(angle), 1.0 + 0.6 * (n % 2))
        mapper.integrate(render(sdf, look_at(eye, around), camera, 0.1 * n))
    mapper.refresh()
    return mapper


def backs_of(mapper):
    bricks = mapper.bricks
    seeds = surface_seeds(bricks.arrays, np.zeros(3, dtype=int), np.array(bricks.table.shape))
    return unseen_backs(seeds, bricks.arrays, mapper.lattice.arrays)


@pytest.fixture(scope="module")
def table():
    return seen_from_above(room(TOP))


def below_the_top(heights, count=400):
    """Points under the table top, at these heights above the floor [m]."""
    across = (torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) - 0.5) * torch.tensor(
        [0.8, 0.6]
    )
    return torch.cat([torch.cat([across, torch.full((count, 1), z)], dim=1) for z in heights])


def test_the_underside_of_a_table_nobody_saw_is_where_it_must_be(table):
    field = table.field()
    inside, under = below_the_top([0.71, 0.73]), below_the_top([0.66, 0.67])
    assert (field.distance(inside) < 0).float().mean() > 0.97
    assert (field.distance(under) > 0).float().mean() > 0.97
    error = field.distance(under) - room(TOP)(under)
    assert error.abs().mean() < 0.015
    _, gradient = field.distance_and_gradient(under)
    assert (gradient[:, 2] < -0.6).float().mean() > 0.9


def test_the_guess_from_the_front_is_not_taken_off_again_behind_a_guessed_back(table):
    """What is close behind a back is as far from it as it is: nodes there had lost a tenth and more of that."""
    heights = [0.63, 0.645, 0.66, 0.675]
    distance = table.field().distance(below_the_top(heights)).view(len(heights), -1)
    backs = backs_of(table)
    under = (np.abs(backs[:, :2]) < [0.4, 0.3]).all(axis=1) & (backs[:, 5] < -0.9)
    expected = float(np.median(backs[under, 2])) - torch.tensor(heights)
    assert (distance.mean(dim=1) > 0.97 * expected - 0.001).all()


def test_nobody_is_sure_of_what_nobody_saw(table):
    field = table.field()
    above = below_the_top([0.78])
    assert field.confidence(above).mean() > 0.9
    assert field.confidence(below_the_top([0.66])).max() <= 0.51


def test_backs_face_away_and_weigh_nothing(table):
    backs = backs_of(table)
    top = (np.abs(backs[:, 2] - 0.7) < 0.05) & (np.abs(backs[:, 0]) < 0.45) & (np.abs(backs[:, 1]) < 0.35)
    assert top.sum() > 300
    assert np.abs(backs[top, 2] - 0.7).mean() < 0.012
    assert (backs[top, 5] < -0.95).mean() > 0.97
    assert (backs[:, 6] == 0).all() and (backs[:, 7] > 0).all()


@pytest.mark.parametrize(
    "solid",
    [
        pytest.param(box((0.0, 0.0, 0.37), (1.0, 0.8, 0.74)), id="chest"),
        pytest.param(union(TOP, box((0.0, 0.0, 0.35), (0.96, 0.76, 0.7))), id="chest-with-a-lid"),
    ],
)
def test_a_solid_has_no_back_inside(solid):
    mapper = seen_from_above(room(solid))
    backs = backs_of(mapper)
    inside = (np.abs(backs[:, :2]) < [0.4, 0.3]).all(axis=1) & (backs[:, 2] > 0.02) & (backs[:, 2] < 0.72)
    assert inside.sum() == 0
    assert (mapper.field().distance(below_the_top([0.66, 0.67])) < 0).all()


def test_a_back_that_was_seen_is_not_guessed():
    """A board on edge, seen from both sides."""
    board = box((0.0, 0.0, 0.6), (1.0, 0.04, 0.5))
    backs = backs_of(seen_from_above(room(board), (0.0, 0.0, 0.6)))
    middle = (np.abs(backs[:, 0]) < 0.4) & (np.abs(backs[:, 1]) < 0.05) & (np.abs(backs[:, 2] - 0.6) < 0.2)
    assert middle.sum() == 0


def test_a_view_of_one_side_of_a_board_leaves_the_other_where_it_was_seen():
    sdf = room(box((0.0, 0.0, 0.6), (1.0, 0.04, 0.5)))
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    points = points * torch.tensor([0.8, 0.24, 0.4]) + torch.tensor([0.0, 0.0, 0.6])
    field = seen_from_above(sdf, (0.0, 0.0, 0.6)).field()
    assert (field.distance(points) - sdf(points)).abs().mean() < 0.0025


@pytest.mark.parametrize("middle", [0.7, 0.71, 0.72, 0.73])
def test_a_thin_shelf_does_not_fall_between_the_nodes(middle):
    """Nodes are 4 cm apart, the shelf is 2 cm thick; and it is not made thicker to hold one."""
    field = seen_from_above(room(box((0.0, 0.0, middle), (1.0, 0.8, 0.02)))).field()
    heights = np.arange(middle - 0.05, middle + 0.02, 0.005)
    across = field.distance(below_the_top(heights)).view(len(heights), -1)
    assert (across.amin(dim=0) < 0).float().mean() > 0.97
    solid = 0.005 * (across < 0).sum(dim=0).float()
    assert solid.mean() < 0.032
    assert (field.distance(below_the_top([middle - 0.09])) > 0).float().mean() > 0.97


def test_no_seeds_have_no_backs(table):
    none = np.zeros((0, 8), dtype=np.float32)
    assert unseen_backs(none, table.bricks.arrays, table.lattice.arrays).shape == (0, 8)


def sheet(origin, normal, across, count, seed=0):
    """Seeds of a square (n, 8) about a point, a little off it."""
    rng = np.random.default_rng(seed)
    normal = np.array(normal) / np.linalg.norm(normal)
    u = np.cross(normal, [0.3, 0.5, 0.8])
    u /= np.linalg.norm(u)
    at = rng.uniform(-across, across, (count, 2))
    seeds = np.zeros((count, 8), dtype=np.float32)
    seeds[:, :3] = np.array(origin) + at[:, :1] * u + at[:, 1:] * np.cross(normal, u)
    seeds[:, :3] += normal * rng.normal(0, 0.003, (count, 1))
    noisy = normal + rng.normal(0, 0.05, (count, 3))
    seeds[:, 3:6] = noisy / np.linalg.norm(noisy, axis=1, keepdims=True)
    seeds[:, 6:] = 1.0, 0.01
    return seeds


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (1, 2, -3)])
def test_seeds_of_one_plane_are_found_across_bricks_and_others_are_not_of_it(normal):
    up = np.array(normal) / np.linalg.norm(normal)
    one, other = sheet((0.3, -0.2, 0.5), normal, 0.6, 3000), sheet(0.3 + 0.08 * up, normal, 0.6, 3000, 1)
    back = sheet((0.3, -0.2, 0.5), -up, 0.6, 500, 2)
    plane, means = planes(np.concatenate([one, other, back]), VOXEL)
    most = np.bincount(plane[:3000]).argmax()
    assert (plane[:3000] == most).mean() > 0.98
    assert (plane[3000:] != most).all()
    assert means[most] @ up > 0.999
    np.testing.assert_allclose(np.linalg.norm(means[np.unique(plane)], axis=1), 1, atol=1e-5)


def test_planes_do_not_depend_on_the_order_of_seeds():
    seeds = np.concatenate(
        [sheet((0, 0, 0), (0, 0, 1), 0.5, 1500), sheet((0, 0, 0.2), (0, 1, 1), 0.5, 1500, 1)]
    )
    order = np.random.default_rng(3).permutation(len(seeds))
    plane, shuffled = planes(seeds, VOXEL)[0], np.empty(len(seeds), dtype=int)
    shuffled[order] = planes(seeds[order], VOXEL)[0]
    sizes = np.sort(np.bincount(plane))[::-1][:2]
    assert sizes.sum() > 0.95 * len(seeds)
    np.testing.assert_allclose(np.sort(np.bincount(shuffled))[::-1][:2], sizes, rtol=0.03)
