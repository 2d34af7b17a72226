"""The swept base contains the robot at every heading, and is light enough to plan with."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import robots
from robots.swept_base import greedy_cover


@pytest.fixture(scope="module")
def tiago() -> robots.Robot:
    return robots.load("tiago")


@pytest.mark.parametrize("posture", ["tucked", "ready"])
def test_contains_the_robot_at_any_heading(tiago: robots.Robot, posture: str) -> None:
    q = tiago.named[posture]
    swept = robots.SweptBase(tiago, q)
    assert swept.num_dofs == 2 and swept.joint_names == ("base_x", "base_y")
    position = torch.tensor([1.5, -0.7])
    centres, radii = swept.spheres(position)
    assert len(radii) == len(swept.sphere_links) == len(swept.floor_spheres) <= 250
    generator = torch.Generator().manual_seed(0)
    at = q.repeat(30, 1)
    at[:, :2] = position
    at[:, 2] = 20 * torch.rand(30, generator=generator) - 10
    robot_centres, robot_radii = tiago.spheres(at)
    directions = torch.nn.functional.normalize(torch.randn(60, 3, generator=generator), dim=-1)
    surface = (robot_centres[:, :, None] + robot_radii[:, None, None] * directions).reshape(-1, 3)
    gap = torch.stack([(torch.cdist(part, centres) - radii).amin(1).max() for part in surface.split(5000)])
    assert gap.max() <= 1e-5


def test_hardly_larger_than_what_the_robot_sweeps(tiago: robots.Robot) -> None:
    q = tiago.named["tucked"]
    centres, radii = tiago.spheres(q)
    swept_centres, swept_radii = robots.SweptBase(tiago, q).spheres(torch.zeros(2))
    reach = (centres[:, :2].norm(dim=-1) + radii).max()
    assert (swept_centres[:, :2].norm(dim=-1) + swept_radii).max() < reach + 0.06


def test_batches_gradients_and_floor(tiago: robots.Robot) -> None:
    swept = robots.SweptBase(tiago, tiago.named["tucked"])
    q = torch.zeros(4, 5, 2, requires_grad=True)
    centres, radii = swept.spheres(q)
    assert centres.shape == (4, 5, len(radii), 3)
    centres[..., 1].sum().backward()
    assert torch.equal(q.grad, torch.tensor([0.0, 1.0]).expand(4, 5, 2) * len(radii))
    assert swept.floor_spheres.any() and not swept.floor_spheres.all()
    assert swept.self_collision_pairs.shape == (0, 2)
    assert torch.equal(swept.velocity_limits, tiago.velocity_limits[:2])


def test_bad_requests_are_refused(tiago: robots.Robot) -> None:
    panda = robots.load("panda")
    with pytest.raises(robots.UnknownJointError, match="base_x"):
        robots.SweptBase(panda, panda.rest)
    with pytest.raises(robots.RobotError, match="max_spheres=3"):
        robots.SweptBase(tiago, tiago.rest, max_spheres=3)
    swept = robots.SweptBase(tiago, tiago.rest)
    with pytest.raises(robots.RobotError, match="base_x"):
        swept.spheres(torch.zeros(3))
    with pytest.raises(robots.RobotError, match="NaN"):
        swept.spheres(torch.tensor([0.0, torch.nan]))


def test_greedy_cover_covers_without_redundancy() -> None:
    rng = np.random.default_rng(0)
    contains = rng.random((200, 40)) < 0.2
    contains[:, 0] |= ~contains.any(1)
    chosen = greedy_cover(contains, np.ones(40))
    assert contains[:, chosen].any(1).all()
    for left_out in range(len(chosen)):
        assert not contains[:, np.delete(chosen, left_out)].any(1).all()
