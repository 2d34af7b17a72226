"""Arm motions of a parked robot: which grasps count as within reach."""

from __future__ import annotations

import pytest
import torch

import planning
import robots
from examples.arm import ARM_ROOM, clearance, parked, reachable_grasps, within_limits
from planning.grasping import Grasps
from planning.validation import check
from tests.planning.fields import Box


def level_grasp(x: float, z: float) -> Grasps:
    """Fingers along x, the closing line along y [m]."""
    T = torch.eye(4)
    T[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    T[:3, 3] = torch.tensor([x, 0.0, z])
    one = torch.ones(1)
    return Grasps(T[None], 0.05 * one, one, one, one)


def test_a_base_that_stands_close_to_a_counter_does_not_keep_the_arm_from_reaching() -> None:
    """It got there; only what moves needs room. An arm that would pass through something does not reach."""
    full = robots.load("tiago")
    model, q = parked(full, full.named["tucked"].double().numpy())
    q = within_limits(model, q)
    near, far = 0.2, 1.0  # front of the counter: bisected until the base is closer to it than an arm may come
    for _ in range(30):
        middle = (near + far) / 2
        field = Box((middle + 0.2, 0.0, 0.2), (0.2, 0.5, 0.1))
        near, far = (near, middle) if clearance(model, q[None], field) > ARM_ROOM / 2 else (middle, far)
    field = Box((far + 0.2, 0.0, 0.2), (0.2, 0.5, 0.1))
    assert 0 < clearance(model, q[None], field) < ARM_ROOM
    assert len(list(reachable_grasps(model, q, level_grasp(0.7, 0.9), field))) == 1
    wall = Box((0.5, 0.0, 0.9), (0.02, 0.6, 0.6))
    assert len(list(reachable_grasps(model, q, level_grasp(0.7, 0.9), wall))) == 0


@pytest.mark.parametrize(("x", "z", "reached"), [(0.65, 1.0, 1), (0.55, 1.2, 0)])
def test_no_arm_reaches_through_its_own_robot(x: float, z: float, reached: int) -> None:
    """The nearest posture touches the head in both; in one there is another, that does not."""
    full = robots.load("tiago")
    model, q = parked(full, full.named["tucked"].double().numpy())
    away = Box((5.0, 0.0, 0.2), (0.2, 0.2, 0.2))
    found = list(reachable_grasps(model, within_limits(model, q), level_grasp(x, z), away))
    assert len(found) == reached
    for grasp in found:
        before = planning.Trajectory.through(grasp.approach[:1])
        assert check(model, before, away).status is planning.Status.SUCCESS
