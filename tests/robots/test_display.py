"""What a prompt and a notebook show of a robot."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

import robots

URDF = """<robot name="r">
<link name="base"><collision><geometry><box size="0.3 0.2 0.1"/></geometry></collision></link>
<link name="arm"><collision><origin xyz="0 0 0.2"/><geometry><box size="0.05 0.05 0.4"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def test_a_robot_tells_its_joints_and_shows_its_spheres(tmp_path) -> None:
    (tmp_path / "r.urdf").write_text(URDF)
    spheres = {"base": np.array([[0, 0, 0, 0.2]]), "arm": np.array([[0, 0, 0.1, 0.05], [0, 0, 0.3, 0.05]])}
    robot = robots.Robot.from_urdf(tmp_path / "r.urdf", robots.SphereSet(spheres))
    assert repr(robot) == "<Robot r: 1 joints (turn), 3 spheres>"
    with Image.open(io.BytesIO(robot._repr_png_())) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert ((pixels[..., 0] - pixels[..., 2]) > 40).sum() > 1000, "spheres are orange"
