"""The fitter covers simple solids within its budget and reports honestly how well."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import robots
from robots.sphere_fitting import SphereFit

BOX = trimesh.creation.box((0.3, 0.2, 0.1))
CYLINDER = trimesh.creation.cylinder(radius=0.1, height=0.3, sections=24)
BALL = trimesh.creation.icosphere(subdivisions=1, radius=0.1)


def gaps(fit: SphereFit, points: np.ndarray) -> np.ndarray:
    return (np.linalg.norm(points[:, None] - fit.spheres[None, :, :3], axis=2) - fit.spheres[:, 3]).min(1)


@pytest.mark.parametrize("solid", [BOX, CYLINDER, BALL], ids=["box", "cylinder", "ball"])
@pytest.mark.parametrize("budget", [10])
def test_solids_are_covered_within_budget(solid: trimesh.Trimesh, budget: int) -> None:
    fit = robots.fit_spheres(solid, budget)
    assert 1 <= len(fit.spheres) <= budget
    rng = np.random.default_rng(1)
    surface, _ = trimesh.sample.sample_surface(solid, 3000, seed=5)
    assert gaps(fit, surface).max() < 2e-3
    inside = rng.uniform(*solid.bounds, (3000, 3))
    assert gaps(fit, inside[solid.contains(inside)]).max() < 2e-3
    assert fit.coverage > 0.995 and fit.max_uncovered < 2e-3


def test_more_spheres_protrude_less() -> None:
    overshoots = [robots.fit_spheres(BOX, budget).overshoot_max for budget in (1, 4, 16)]
    assert overshoots[0] > 1.5 * overshoots[1] > 2 * overshoots[2]


def test_a_ball_is_one_sphere_and_a_box_its_circumscribed_sphere() -> None:
    ball = robots.fit_spheres(BALL, 5)
    assert len(ball.spheres) == 1
    np.testing.assert_allclose(ball.spheres[0], [0, 0, 0, 0.1], atol=5e-3)
    box = robots.fit_spheres(BOX, 1)
    half = np.array([0.15, 0.1, 0.05])
    np.testing.assert_allclose(box.spheres[0], [0, 0, 0, np.linalg.norm(half)], atol=5e-3)
    assert box.overshoot_max == pytest.approx(np.linalg.norm(half) - 0.05, abs=0.01)


def test_the_union_of_pieces_is_covered_not_each_piece() -> None:
    halves = [BOX.copy().apply_translation((x, 0, 0)) for x in (-0.1, 0.1)]  # overlapping boxes: 0.5 m long
    fit = robots.fit_spheres(halves, 10)
    for half in halves:
        surface, _ = trimesh.sample.sample_surface(half, 2000, seed=2)
        assert gaps(fit, surface).max() < 2e-3


def test_spheres_stay_above_the_lowest_height() -> None:
    fit = robots.fit_spheres(CYLINDER, 30, lowest=-0.17)
    assert (fit.spheres[:, 2] - fit.spheres[:, 3]).min() > -0.171
    surface, _ = trimesh.sample.sample_surface(CYLINDER, 2000, seed=2)
    assert gaps(fit, surface).max() < 2e-3


def test_impossible_requests_are_refused() -> None:
    with pytest.raises(robots.RobotError, match="budget is 0"):
        robots.fit_spheres(BOX, 0)
    with pytest.raises(robots.RobotError, match="no geometry"):
        robots.fit_spheres([], 4)
    with pytest.raises(robots.RobotError, match="lowest"):
        robots.fit_spheres(BOX, 4, lowest=0.0)  # half of the box is below


def test_a_whole_robot_is_covered(tmp_path) -> None:
    urdf = tmp_path / "r.urdf"
    link = '<link name="{0}"><collision><origin xyz="{2}"/><geometry>{1}</geometry></collision></link>'
    joint = (
        '<joint name="j{1}" type="{2}"><origin xyz="{3}"/><parent link="{0}"/><child link="{1}"/>{4}</joint>'
    )
    limit = '<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/>'
    rod = '<cylinder radius="0.03" length="0.3"/>'
    urdf.write_text(
        '<robot name="r">'
        + link.format("base", '<box size="0.4 0.3 0.2"/>', "0 0 0.1")
        + link.format("cap", '<box size="0.1 0.1 0.1"/>', "0 0 0.05")
        + link.format("upper", rod, "0 0 0.15")
        + link.format("lower", rod, "0 0 0.15")
        + link.format("wheel", '<sphere radius="0.02"/>', "0 0 0")
        + joint.format("base", "cap", "fixed", "0 0 0.2", "")
        + joint.format("base", "wheel", "fixed", "0 0 0.03", "")
        + joint.format("cap", "upper", "revolute", "0 0 0.1", limit)
        + joint.format("upper", "lower", "revolute", "0 0 0.3", limit)
        + "</robot>"
    )
    spheres, report = robots.fit_robot(
        urdf,
        40,
        skip=["wheel"],
        lowest={"base": -0.025},
        floor_links=["base"],
        config=robots.RobotFitConfig(pairs=robots.PairConfig(samples=500)),
    )
    assert len(spheres) <= 40
    assert set(report) == {"base", "upper", "lower"}  # the cap is fixed to the base: one body
    assert max(fit.max_uncovered for fit in report.values()) < 2e-3
    neighbours = {frozenset(p) for p in (("base", "cap"), ("cap", "upper"), ("upper", "lower"))}
    assert neighbours <= spheres.ignored_pairs
    # Folded back by 2 rad at both joints, the lower rod reaches the base: this pair must be tested.
    assert frozenset(("base", "lower")) not in spheres.ignored_pairs
    base = spheres.spheres["base"]
    assert (base[:, 2] - base[:, 3]).min() > -0.026
    with pytest.raises(robots.UnknownLinkError, match="elbow"):
        robots.fit_robot(urdf, 40, skip=["elbow"])
    with pytest.raises(robots.RobotError, match="2 spheres"):
        robots.fit_robot(urdf, 2)
