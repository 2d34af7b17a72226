"""Sphere files: what is written is read back, cuRobo's layout is understood, mistakes are explained."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

import robots

SPHERES = {
    "a": np.array([[0.1, 0.2, -0.3, 0.05], [0.0, 0.0, 0.0, 0.12345]]),
    "b": np.array([[1.0, 0.0, 0.0, 0.02]]),
}


def test_round_trip(tmp_path: Path) -> None:
    written = robots.SphereSet(SPHERES, frozenset({frozenset({"a", "b"})}), frozenset({"b"}))
    robots.save_spheres(tmp_path / "s.yaml", written)
    read = robots.load_spheres(tmp_path / "s.yaml")
    assert read.ignored_pairs == written.ignored_pairs
    assert read.floor_links == written.floor_links
    for link, rows in SPHERES.items():
        np.testing.assert_allclose(read.spheres[link], rows, atol=1.01e-4)
        assert (read.spheres[link][:, 3] >= rows[:, 3] - 1e-9).all()  # rounding never makes a sphere smaller
    assert len(read) == 3


def test_bare_layout_and_disabled_spheres(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(
        "collision_spheres:\n  a: [{center: [0, 0, 1], radius: 0.1}]\n  held: [{center: [0, 0, 0], radius: -1}]\n"
    )
    read = robots.load_spheres(path)
    assert list(read.spheres) == ["a"]
    assert read.spheres["a"].tolist() == [[0.0, 0.0, 1.0, 0.1]]


def test_spheres_in_a_second_file(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("collision_spheres:\n  a: [{center: [0, 0, 1], radius: 0.1}]\n")
    main = tmp_path / "robot.yaml"
    main.write_text(
        "robot_cfg:\n  kinematics:\n    collision_spheres: s.yaml\n    self_collision_ignore: {a: [b]}\n"
    )
    assert robots.load_spheres(main).ignored_pairs == {frozenset({"a", "b"})}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", "mapping"),
        ("a: 1", "collision_spheres"),
        ("", "mapping"),
        ("collision_spheres: {}", "collision_spheres"),
        ("collision_spheres: {a: [], b: []}", "no sphere in it"),
        ("collision_spheres: {a: 3}", "list"),
        ("robot_cfg: 3", "collision_spheres"),
        (
            "collision_spheres: {a: [{center: [0, 0, 0], radius: 1}]}\nself_collision_ignore: [a]",
            "self_collision_ignore",
        ),
        ("a: [", "valid YAML"),
        ("collision_spheres:\n  a: [{center: [0, 0], radius: 1}]", "center"),
        ("collision_spheres:\n  a: [{radius: 1}]", "center"),
        ("collision_spheres:\n  a: [{center: [0, 0, 0], radius: 0}]", "radius > 0"),
        ("collision_spheres:\n  a: [{center: [0, 0, .nan], radius: 1}]", "finite"),
        ("collision_spheres:\n  a: [{center: [0, 0, 0], radius: .nan}]", "finite"),
    ],
)
def test_mistakes_are_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(robots.SphereFileError, match=message):
        robots.load_spheres(path)


def test_missing_file_and_unknown_links(tmp_path: Path) -> None:
    with pytest.raises(robots.SphereFileError, match=r"nothing\.yaml"):
        robots.load_spheres(tmp_path / "nothing.yaml")
    panda = robots.load("panda")
    with pytest.raises(robots.SphereFileError, match="no collision sphere"):
        panda.with_spheres(robots.SphereSet({}))
    with pytest.raises(robots.UnknownLinkError, match=r"elbow.*panda_link3"):
        robots.Robot.from_urdf(panda.urdf_path, robots.SphereSet({"elbow": SPHERES["a"]}))


def test_published_curobo_file_fits_the_panda() -> None:
    data = os.environ.get("ISDF_DATA_DIR")
    if not data:
        pytest.skip("ISDF_DATA_DIR is not set: no published sphere files to read")
    published = robots.load_spheres(Path(data) / "spheres" / "curobo_franka.yml")
    panda = robots.load("panda")
    robot = robots.Robot.from_urdf(panda.urdf_path, published.restricted_to(panda.tree.links))
    assert len(robot.sphere_links) > 50
    assert len(robot.self_collision_pairs) > 0
