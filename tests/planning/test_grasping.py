"""Grasps found in a distance field: the object told from its support, opposite faces, room for the hand, the unseen."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from planning.errors import ConfigError, FieldError
from planning.grasping import GraspConfig, find_grasps
from planning.hand_room import ParallelHand, RoomRound
from planning.hidden_sides import hidden_sides
from planning.line_of_sight import in_sight
from planning.object_surface import SurfaceConfig, object_surface
from tests.planning.fields import AutogradField, Box, Sphere, Union

TABLE = Box((0.0, 0.0, 0.35), (0.5, 0.3, 0.35))  # its top is at 0.7 m
HAND = ParallelHand(
    torch.tensor([[0.0, s * 0.05, -z] for s in (-1, 1) for z in (0.0, 0.02, 0.04)] + [[0.0, 0.0, -0.09]]),
    torch.tensor([0.01] * 6 + [0.045]),
    opening=0.08,
    tips=0.01,
)


def carton(yaw: float = 0.0) -> AutogradField:
    """5 x 15 x 12 cm on the table, turned."""
    return Turned(Box((0.0, 0.0, 0.76), (0.025, 0.075, 0.06)), yaw)


class Turned(AutogradField):
    def __init__(self, field: AutogradField, yaw: float) -> None:
        c, s = math.cos(yaw), math.sin(yaw)
        self.field, self.turn = field, torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def distance(self, points):
        return self.field.distance(points @ self.turn)


class Shell(AutogradField):
    """What a map knows of a thing: a shell of a centimetre or two, and nothing solid in it."""

    THICK = 0.02

    def __init__(self, field: AutogradField) -> None:
        self.field = field

    def distance(self, points):
        distance = self.field.distance(points)
        return torch.maximum(distance, -distance - self.THICK)


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_an_object_is_told_from_its_support(yaw: float) -> None:
    field = Union(TABLE, carton(yaw), Box((0.3, 0.0, 0.76), (0.03, 0.03, 0.06)))
    surface = object_surface(field, torch.tensor([0.0, 0.0, 0.823]))
    assert surface is not None
    assert surface.support == pytest.approx(0.7, abs=0.003)
    assert len(surface.points) > 500
    assert carton(yaw).distance(surface.points).abs().max() < 0.003, (
        "neither the table nor the thing beside it"
    )
    assert surface.points[:, 2].min() < 0.72 and surface.points[:, 2].max() > 0.815
    flat = surface.points[:, 2] < 0.8
    assert (surface.normals[flat, 2].abs() < 0.2).float().mean() > 0.95


def test_where_nothing_stands_there_is_no_object() -> None:
    assert object_surface(TABLE, torch.tensor([0.1, 0.0, 0.7])) is None
    with pytest.raises(FieldError, match="finite"):
        object_surface(TABLE, torch.tensor([0.1, math.nan, 0.7]))
    for wrong in (torch.zeros(2), torch.zeros(1, 3)):
        with pytest.raises(FieldError, match="3 finite numbers, got shape"):
            object_surface(TABLE, wrong)
    beside = Union(TABLE, Box((0.2, 0.0, 0.76), (0.03, 0.03, 0.06)))
    assert object_surface(beside, torch.tensor([0.05, 0.0, 0.7])) is None, (
        "what stands elsewhere is not meant"
    )
    with pytest.raises(ConfigError, match="positive"):
        SurfaceConfig(gap=0.0)


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_grasps_close_across_the_narrow_side_and_touch_nothing(yaw: float) -> None:
    field = Union(TABLE, carton(yaw))
    surface = object_surface(field, torch.tensor([0.0, 0.0, 0.823]))
    grasps = find_grasps(field, surface, HAND)
    assert len(grasps) > 5
    narrow = torch.tensor([math.cos(yaw), math.sin(yaw), 0.0])
    across = (grasps.T_world_tool[:, :3, 1] @ narrow).abs()
    assert across.min() > math.cos(math.radians(32)) and across[0] > math.cos(math.radians(12))
    assert (grasps.width - 0.05).abs()[across > 0.995].max() < 0.006
    assert (grasps.score.diff() <= 1e-6).all(), "the best first"
    assert RoomRound(field, surface).clearance(grasps.T_world_tool, HAND, 0.12).min() >= GraspConfig().room
    tips = grasps.T_world_tool[:, :3, 3] + HAND.tips * grasps.T_world_tool[:, :3, 2]
    assert carton(yaw).distance(tips).max() < 0.0, "the object is between the fingers"
    turns = grasps.T_world_tool[:, :3, :3]
    assert (turns @ turns.transpose(1, 2) - torch.eye(3)).abs().max() < 1e-5
    assert (torch.linalg.det(turns) > 0).all()


def test_what_is_too_wide_or_shut_in_has_no_grasp() -> None:
    wide = Union(TABLE, Box((0.0, 0.0, 0.76), (0.06, 0.06, 0.06)))
    surface = object_surface(wide, torch.tensor([0.0, 0.0, 0.823]))
    assert len(find_grasps(wide, surface, HAND)) == 0
    shut = Union(
        TABLE, carton(), Box((0.0, 0.0, 0.93), (0.4, 0.4, 0.08)), Box((0.075, 0.0, 0.76), (0.03, 0.3, 0.2))
    )
    surface = object_surface(Union(TABLE, carton()), torch.tensor([0.0, 0.0, 0.823]))
    assert len(find_grasps(shut, surface, HAND)) == 0


def test_the_robots_side_is_preferred() -> None:
    field = Union(TABLE, carton())
    surface = object_surface(field, torch.tensor([0.0, 0.0, 0.823]))
    for heading in (math.pi / 2, -math.pi / 2):
        best = find_grasps(field, surface, HAND, heading).T_world_tool[0, :3, 2]
        assert best[1] * math.sin(heading) > -0.01


FRONT = torch.tensor([[0.0, -0.7, 1.1]])
ABOVE = torch.tensor([[0.0, -0.7, 1.1], [0.0, 0.0, 1.8]])


def test_lines_of_sight_tell_the_front_from_the_back() -> None:
    field = Shell(Union(TABLE, carton()))
    near, far = torch.tensor([[0.0, -0.077, 0.78]]), torch.tensor([[0.0, 0.077, 0.78]])
    inside = torch.tensor([[0.0, -0.03, 0.76]])
    assert bool(in_sight(field, near, FRONT)) and not bool(in_sight(field, far, FRONT))
    assert not bool(in_sight(field, inside, FRONT)), "a shell is not all of a thing"
    assert bool(in_sight(field, far, torch.cat([FRONT, torch.tensor([[0.0, 0.7, 1.1]])]))), (
        "from any of the eyes"
    )


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_sides_that_nobody_saw_go_down_from_the_top(yaw: float) -> None:
    """From the front a map has a shell; its back is no face of the thing, and the thing's back is guessed."""
    field = Shell(Union(TABLE, carton(yaw)))
    surface = object_surface(field, torch.tensor([0.0, 0.0, 0.823]), FRONT)
    assert surface is not None
    assert carton(yaw).distance(surface.points).abs().max() < 0.012, "the back of the shell is left out"
    assert carton(yaw).distance(surface.points).abs().median() < 0.003
    behind = torch.tensor([-math.sin(yaw), math.cos(yaw), 0.0])
    back = surface.points[(surface.points @ behind > 0.065) & (surface.points[:, 2] < 0.79)]
    assert len(back) > 50 and float((back @ behind - 0.075).abs().mean()) < 0.005


def test_what_was_seen_to_be_free_is_not_filled() -> None:
    """A plate on a stem has nothing under its rim where the camera looks under it."""
    mushroom = Union(Box((0.0, 0.0, 0.81), (0.08, 0.08, 0.01)), Box((0.0, 0.0, 0.75), (0.015, 0.015, 0.05)))
    eyes = torch.tensor([[0.0, -0.6, 0.78], [0.6, 0.0, 0.78], [-0.6, 0.0, 0.78]])
    surface = object_surface(Union(TABLE, mushroom), torch.tensor([0.0, -0.08, 0.81]), eyes)
    assert surface is not None
    low = surface.points[surface.points[:, 2] < 0.78]
    assert len(low) > 20
    assert low[:, 1].min() > -0.04 and low[:, 0].abs().max() < 0.04


def test_where_all_was_seen_to_be_free_no_side_is_guessed() -> None:
    points = torch.tensor([[0.0, 0.0, 0.05], [0.02, 0.0, 0.05], [0.0, 0.02, 0.06]])
    far = Sphere((0.0, 0.0, 50.0), 0.1)
    sides, normals, middle = hidden_sides(far, points, 0.0, torch.tensor([[1.0, 0.0, 1.0]]))
    assert len(sides) == len(normals) == 0
    torch.testing.assert_close(middle, points.mean(dim=0))


def test_fingers_stay_out_of_space_that_nobody_saw() -> None:
    """Low behind a thing may be more of it."""
    broad = Union(TABLE, Box((0.0, 0.0, 0.76), (0.1, 0.025, 0.06)))
    at = torch.tensor([0.0, -0.025, 0.78])
    strict = GraspConfig(seen=0.9, pitches=(math.pi / 2,), bites=(0.05,))
    assert len(find_grasps(broad, object_surface(broad, at, FRONT), HAND, config=strict)) == 0
    assert len(find_grasps(broad, object_surface(broad, at, ABOVE), HAND, config=strict)) > 5
    low = torch.tensor([[0.0, 0.05, 0.72]])
    assert bool(RoomRound(broad, object_surface(broad, at, FRONT)).hidden(low))
    assert not bool(RoomRound(broad, object_surface(broad, at, ABOVE)).hidden(low))


@pytest.mark.parametrize("tilt", [0.0, 0.04])
def test_flat_things_are_taken_from_above(tilt: float) -> None:
    """A ruler 12 mm high, on a table that a camera's distortion tilts: the fingers end just above it."""
    height = 0.012
    field = Tilted(Union(TABLE, Box((0.0, 0.0, 0.7 + height / 2), (0.1, 0.012, height / 2))), tilt)
    at = torch.tensor([0.0, 0.0, 0.7 + height])
    surface = object_surface(field, at)
    assert surface is not None and surface.support == pytest.approx(0.7, abs=0.002)
    assert surface.points[:, 1].abs().max() < 0.016, "neither half of the table is part of it"
    assert field.distance(surface.points).abs().max() < 0.004
    assert surface.points[:, 0].max() - surface.points[:, 0].min() == pytest.approx(0.2, abs=0.012)
    grasps = find_grasps(field, surface, HAND)
    assert len(grasps) > 0
    assert (grasps.T_world_tool[:, 2, 2] < -0.2).any(), "from above"
    lowest = grasps.T_world_tool[:, 2, 3] - HAND.below(grasps.T_world_tool[:, :3, :3])
    assert lowest.min() > 0.7 + 0.5 * GraspConfig().above
    assert lowest.min() < 0.7 + height


def test_a_level_hand_stays_over_the_support() -> None:
    field = Union(TABLE, carton())
    surface = object_surface(field, torch.tensor([0.0, 0.0, 0.823]))
    config = GraspConfig(pitches=(0.0,), bites=(0.012, 0.02), antipodal=0.5)
    low = replace(surface, middle=torch.tensor([0.0, 0.0, 0.7]))  # a heavy foot: low grasps are the best
    grasps = find_grasps(field, low, HAND, config=config)
    assert len(grasps) > 0
    T = grasps.T_world_tool
    lowest = (
        torch.stack([T[:, :3, :3] @ centre for centre in HAND.centres])[..., 2]
        + T[:, 2, 3]
        - HAND.radii[:, None]
    )
    assert lowest.min() > surface.support + 0.9 * config.above


class Tilted(AutogradField):
    """A field turned about the y axis through the table's middle, at its height."""

    def __init__(self, field: AutogradField, angle: float) -> None:
        c, s = math.cos(angle), math.sin(angle)
        self.inner, self.turn = Lifted(field), torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    def distance(self, points):
        return self.inner.distance((points - torch.tensor([0.0, 0.0, 0.7])) @ self.turn)


class Lifted(AutogradField):
    """A field whose origin is the middle of the table's top."""

    def __init__(self, field: AutogradField) -> None:
        self.field = field

    def distance(self, points):
        return self.field.distance(points + torch.tensor([0.0, 0.0, 0.7]))


def test_a_thing_is_taken_where_it_is_heavy() -> None:
    """A hammer's head holds most of its volume; a hand at the end of the handle would let it turn."""
    head, handle = Box((0.12, 0.0, 0.72), (0.03, 0.035, 0.02)), Box((-0.03, 0.0, 0.71), (0.13, 0.01, 0.01))
    field = Union(TABLE, head, handle)
    eyes = torch.tensor([[0.0, -0.5, 1.3], [0.0, 0.5, 1.3], [0.5, 0.0, 1.3], [-0.5, 0.0, 1.3]])
    surface = object_surface(field, torch.tensor([-0.02, 0.0, 0.72]), eyes)
    assert surface is not None
    volumes = torch.tensor([0.06 * 0.07 * 0.04, 0.26 * 0.02 * 0.02])
    middle = (volumes * torch.tensor([0.12, -0.03])).sum() / volumes.sum()
    assert float(surface.middle[0]) == pytest.approx(float(middle), abs=0.02)
    best = find_grasps(field, surface, HAND).T_world_tool[:3, 0, 3]
    assert (best - middle).abs().max() < 0.06
