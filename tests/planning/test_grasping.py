"""Grasps found in a distance field: the object told from its support, opposite faces, room for the hand, the unseen."""

from __future__ import annotations

import math

import pytest
import torch

from planning.errors import ConfigError, FieldError
from planning.grasping import GraspConfig, ParallelHand, find_grasps, hand_clearance
from planning.object_surface import SurfaceConfig, object_surface
from tests.planning.fields import AutogradField, Box, Union

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


class SeenFrom(AutogradField):
    """A field that is sure only of what lies on one side of a plane through the origin."""

    def __init__(self, field: AutogradField, side: tuple[float, float, float]) -> None:
        self.field, self.side = field, torch.tensor(side)

    def distance(self, points):
        return self.field.distance(points)

    def confidence(self, points):
        return (points @ self.side > -0.02).float()


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
    assert hand_clearance(field, grasps.T_world_tool, HAND, 0.12).min() >= GraspConfig().room
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


def test_fingers_stay_out_of_space_that_nobody_saw() -> None:
    """Seen from x < 0 only, a plate's far side is a guess; a finger there may meet anything."""
    field = Union(TABLE, carton())
    surface = object_surface(field, torch.tensor([0.0, 0.0, 0.823]))
    assert len(find_grasps(SeenFrom(field, (-1.0, 0.0, 0.0)), surface, HAND)) == 0
    assert len(find_grasps(SeenFrom(field, (0.0, 0.0, 1.0)), surface, HAND)) > 5
    guessed = SeenFrom(field, (-1.0, 0.0, 0.0))
    seen = object_surface(guessed, torch.tensor([0.0, 0.0, 0.823]))
    assert seen is not None and seen.points[:, 0].max() <= 0.021
