"""Who walks by is taken back out of the map; what stays, and the room itself, is not."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from isdf import ConfigError, Mapper, MapperConfig, PinholeCamera
from isdf.mapping.bricks import BrickVolume
from isdf.mapping.departed import looked_past
from isdf.mapping.lately import Lately
from isdf.mapping.lattice import Lattice
from isdf.mapping.seeds import kept_seeds
from isdf.mapping.standing import columns, feet, parts
from isdf.mapping.visitors import Visitors
from tests.isdf.rooms import box, furnished_room, look_at, render, union

CAMERA = PinholeCamera.from_fov(64, 48, math.radians(70))
EYE = (-1.6, -1.5, 1.3)
THERE, ASIDE = (0.3, 0.2, 0.5), (-1.5, 1.2, 0.5)
FPS = 5


def person(x, y, height=1.2):
    """Somebody."""
    return box((x, y, height / 2), (0.3, 0.3, height))


def watch(mapper, at, seconds, place=None, height=1.2):
    """Look at a place for a while; somebody may stand there, or walk if `place` is a function of the share of it."""
    start = mapper.frames_seen / FPS
    for n in range(round(seconds * FPS)):
        where = place(n / (seconds * FPS)) if callable(place) else place
        # A camera never gives the same image twice.
        eye = (EYE[0] + 0.02 * (n % 3), *EYE[1:])
        mapper.integrate(replace(seen(eye, at, where, height), time=start + n / FPS))


@functools.lru_cache(maxsize=64)
def seen(eye, at, where, height):
    """An image from an eye towards a place; somebody may stand in it."""
    room = furnished_room() if where is None else union(furnished_room(), person(*where, height))
    return render(room, look_at(eye, at), CAMERA)


def around(x, y):
    """Points in and near somebody [m]."""
    generator = torch.Generator().manual_seed(0)
    return torch.tensor([x, y, 0.6]) + (torch.rand(300, 3, generator=generator) - 0.5) * torch.tensor(
        [0.4, 0.4, 1.0]
    )


def walking(share):
    """Into view and across it, at 0.5 m/s."""
    return 0.9 - 1.25 * share, -1.0 + 0.4 * share


LAST = walking(1.0)


@functools.cache
def mapped(memory):
    """A map of the room, of somebody who walked through it, and of another corner looked at for long."""
    mapper = Mapper(MapperConfig(visitors=memory))
    watch(mapper, THERE, 2.0)
    before = mapper.field()
    watch(mapper, THERE, 2.6, walking)
    mapper.refresh()
    during = mapper.field()
    watch(mapper, ASIDE, 3.0, LAST)
    mapper.refresh()
    return before, during, mapper.field()


def test_who_walks_out_of_view_is_taken_back():
    before, during, after = mapped(2.0)
    points = around(*LAST)
    assert (during.distance(points) < 0.1).float().mean() > 0.5
    assert (after.distance(points) - before.distance(points)).abs().mean() < 0.02
    assert (after.observed(points) | ~before.observed(points)).float().mean() > 0.98
    assert during.came(points).float().mean() > 0.8 and not (before.came(points) | after.came(points)).any()
    assert not during.came(points + torch.tensor([0.0, 1.5, 0.0])).any()


def test_furniture_beside_somebody_who_came_has_not_come():
    before, during, _ = mapped(2.0)
    points = (torch.rand(60_000, 3, generator=torch.Generator().manual_seed(2)) - 0.5) * torch.tensor(
        [2.4, 2.4, 1.2]
    )
    points = points + torch.tensor([*LAST, 0.7])
    person_there, room = person(*LAST)(points), furnished_room()(points)
    surface = before.distance(points).abs() < 0.02
    beside = surface & (room.abs() < 0.03) & (person_there > 0.15) & (person_there < 0.8)
    assert beside.sum() > 50
    assert during.came(points[beside]).float().mean() < 0.1


def test_a_map_that_never_forgets_keeps_it():
    _, during, after = mapped(None)
    points = around(*LAST)
    assert (after.distance(points) - during.distance(points)).abs().mean() < 0.02
    assert not during.came(points).any()


def test_the_room_stays_as_it_was():
    before, _, after = mapped(2.0)
    points = (torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)) - 0.5) * torch.tensor(
        [3.6, 3.6, 2.0]
    )
    points = points + torch.tensor([0.0, 0.0, 1.0])
    truth = furnished_room()(points)
    seen = before.observed(points) & (truth > 0)
    errors = [(field.distance(points[seen]) - truth[seen]).abs().mean() for field in (before, after)]
    assert errors[1] < 1.1 * errors[0]


def test_who_is_seen_from_the_waist_up_stands_on_the_floor():
    place = (EYE[0] + 0.7, EYE[1] + 0.7)
    shin = torch.linspace(-0.1, 0.1, 5)
    west, south = torch.full((5,), place[0] - 0.15), torch.full((5,), place[1] - 0.15)
    sides = torch.cat([torch.stack([west, place[1] + shin], 1), torch.stack([place[0] + shin, south], 1)])
    legs = torch.cat([torch.cat([sides, torch.full((10, 1), height)], dim=1) for height in (0.2, 0.4)])
    errors = []
    for memory in (None, 2.0):
        mapper = Mapper(MapperConfig(visitors=memory))
        watch(mapper, THERE, 2.0)
        watch(mapper, (*place, EYE[2] + 0.1), 1.0, place)
        mapper.refresh()
        errors.append(float(mapper.field().distance(legs).abs().mean()))
    assert errors[0] > 0.05 and errors[1] < 0.4 * errors[0], errors


def test_what_is_seen_to_stay_is_kept():
    mapper = Mapper(MapperConfig(visitors=2.0))
    watch(mapper, THERE, 2.0)
    watch(mapper, THERE, 14.0, LAST)
    during = mapper.field()
    points = around(*LAST)
    surface = points[during.distance(points).abs() < 0.05]
    assert during.came(surface).float().mean() > 0.9
    watch(mapper, THERE, 2.0, LAST)
    watch(mapper, ASIDE, 20.0, LAST)
    mapper.refresh()
    assert (mapper.field().distance(points) - during.distance(points)).abs().mean() < 0.02
    assert not mapper.field().came(points).any()


def test_who_stood_for_a_while_is_kept_as_long_again():
    mapper = Mapper(MapperConfig(visitors=2.0))
    watch(mapper, THERE, 2.0)
    before = mapper.field()
    watch(mapper, THERE, 6.0, LAST)
    during = mapper.field()
    points = around(*LAST)
    for seconds, kept in ((4.0, True), (4.0, False)):
        watch(mapper, ASIDE, seconds, LAST)
        expected = during if kept else before
        assert (mapper.field().distance(points) - expected.distance(points)).abs().mean() < 0.02


def test_what_was_never_seen_free_is_no_visitor():
    mapper = Mapper(MapperConfig(visitors=2.0))
    watch(mapper, THERE, 1.0, LAST)
    during = mapper.field()
    watch(mapper, ASIDE, 4.0, LAST)
    points = around(*LAST)
    assert (mapper.field().distance(points) - during.distance(points)).abs().mean() < 0.02


@pytest.mark.parametrize("memory", [0.0, -1.0, math.nan, math.inf])
def test_memories_that_are_none_are_refused(memory):
    with pytest.raises(ConfigError, match="visitors"):
        MapperConfig(visitors=memory)


@pytest.mark.parametrize("first", [0.0, math.inf])
def test_only_places_that_something_came_into_are_given_back(first):
    bricks, lattice = BrickVolume(0.02, 100_000), Lattice(0.16)
    for volume in (bricks, lattice):
        volume.include(np.zeros(3), np.ones(3))
    place = np.array([[1, 1, 1]])
    bricks.add(2 * place + np.argwhere(np.ones((2, 2, 2))) - bricks.corner)
    visitors = Visitors(bricks, lattice, before=0.06, memory=2.0)
    visitors._kept = visitors._copied(place, 1.0)._replace(first=np.array([first]))
    bricks.weight[:], bricks.distance[:] = 1.0, 0.02  # a surface
    box = visitors.take_back(np.array([9.0, 0.0, 0.0]), 2.9)
    assert box is None, "not yet"
    box = visitors.take_back(np.array([9.0, 0.0, 0.0]), 3.1)
    if math.isinf(first):
        assert box is None and (bricks.weight == 1).all()
    else:
        np.testing.assert_allclose(box, [[0.32] * 3, [0.64] * 3])
        assert (bricks.weight == 0).all()


def test_what_belongs_to_something_that_came_may_lie_a_little_beside_its_bricks():
    lately = Lately.of(np.array([[1, 0, -2], [5, 0, -2]]), 0.08)  # the first from x = 0.08 to 0.16
    x = np.array([-0.01, 0.01, 0.12, 0.23, 0.25, 0.42, np.nan])
    points = np.stack([x, np.full(7, 0.05), np.full(7, -0.1)], axis=1)
    assert lately.near(points).tolist() == [False, True, True, True, False, True, False]
    assert lately.near(points + np.array([0.0, 0.1, 0.05])).tolist() == lately.near(points).tolist(), (
        "at the corners, too"
    )
    assert (
        not lately.near(points + np.array([0.0, 0.2, 0.0])).any()
        and not lately.near(points - np.array([0.0, 0.0, 0.2])).any()
    )
    assert not Lately.of(np.empty((0, 3), dtype=np.int64), 0.08).near(points).any()


def test_who_was_close_has_gone_when_the_camera_looks_past_him():
    """A camera 1.3 m up looks along x; bricks of 32 cm, 60 cm before it, at its height and on the floor."""
    pose = look_at((0.0, 0.0, 1.3), (1.0, 0.0, 1.3))
    intrinsics = tuple(float(v) for v in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy))
    place = np.array(
        [[1, 0, 4], [1, 0, 0], [1, -2, 0], [-2, 0, 4]]
    )  # the third is low, the last behind the camera
    seen, far, near = np.array([True, False, True, True]), np.full((48, 64), 3.0), np.full((48, 64), 0.75)

    def past(depth, seen=seen):
        return looked_past(place, seen, 0.32, depth, intrinsics, pose, axis=2).tolist()

    assert past(far) == [True, True, False, False]
    assert past(near) == [False] * 4, "he may stand at the back of the brick"
    assert past(0 * far) == [False] * 4
    assert past(far, np.array([False, True, True, True])) == [False] * 4, "it was never seen to be tall"


@pytest.mark.parametrize("way", [1, -1])
def test_he_stands_by_what_is_seen_of_him_in_the_two_lowest_places(way):
    pixels = np.zeros((3, 1, 7), dtype=np.int32)
    pixels[0, 0, 3:6], pixels[1, 0, 3] = 60, 60
    pixels[2, 0, 4], pixels[2, 0, 6] = 60, 60  # between both it is somebody else, or nobody
    expected = [[0, 0, 4, 4, 1], [1, 0, 3, 3, 0], [2, 0, 4, 4, 0]]
    if way < 0:
        pixels, expected = pixels[:, :, ::-1], [[x, y, 6 - z, *rest] for x, y, z, *rest in expected]
    found = feet(pixels, np.ones_like(pixels, dtype=bool), 2, way, 0 if way > 0 else 6)
    assert found.tolist() == expected
    highest = parts(found, 2, 2, way)
    assert highest[0].tolist() == [0, 0, 9 if way > 0 else 4, 9, 2] and highest[4].tolist()[3:] == [7, 0]
    assert len(columns(found, 2, way)) == 5 + 4 + 5


def test_who_goes_takes_his_feet_along_though_a_ray_passed_him_while_he_stood():
    """What was seen of him reaches into a column of places whose middle is beside him."""
    place, mapper = (EYE[0] + 0.6, EYE[1] + 0.6), Mapper(MapperConfig(visitors=2.0))
    watch(mapper, THERE, 2.0)
    watch(mapper, (*place, EYE[2]), 0.8, place, 1.7)
    box = np.array([*place, 0.8]) + np.array([[-0.6, -0.6, -1.3], [0.6, 0.6, 1.3]])

    def strange():
        seeds = kept_seeds(mapper.bricks, *mapper.bricks.box(*box))[:, :3].copy()
        return int((furnished_room()(torch.from_numpy(seeds)).abs() > 0.05).sum())

    assert strange() > 500
    watch(mapper, (*THERE[:2], EYE[2]), 0.6)
    assert strange() == 0


def test_who_stood_close_is_taken_back_as_soon_as_the_camera_looks_past_him():
    place, changed = (EYE[0] + 0.6, EYE[1] + 0.6), []
    points = around(*place) - torch.tensor([0.0, 0.0, 0.4])
    for away, still, seconds in ((THERE, None, 0.6), ((EYE[0] - 1.0, EYE[1]), place, 3.0)):
        mapper = Mapper(MapperConfig(visitors=2.0))
        watch(mapper, THERE, 2.0)
        before = mapper.field().distance(points)
        watch(mapper, (*place, EYE[2]), 0.8, place, 1.7)
        mapper.refresh()
        assert mapper.field().came(points).any()
        watch(mapper, (*away[:2], EYE[2]), seconds, still, 1.7)
        mapper.refresh()
        changed.append(float((mapper.field().distance(points) - before).abs().mean()))
    assert changed[0] < 0.015 and changed[1] > 0.05, changed
