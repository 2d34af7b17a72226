from __future__ import annotations

import pytest
import torch

from robots.simulation import Box, Scene
from robots.simulation.poses import planar_pose
from tests.robots.simulation.models import MOBILE, inertia


@pytest.fixture(scope="session")
def cart_urdf(tmp_path_factory) -> str:
    """A mobile robot on virtual planar joints: chassis, wheel, one arm joint, pan-tilt head, camera."""
    virtual, parent = "", "odom"
    for name, kind, axis, child in (
        ("base_x", "prismatic", "1 0 0", "base_x_link"),
        ("base_y", "prismatic", "0 1 0", "base_y_link"),
        ("base_yaw", "continuous", "0 0 1", "chassis"),
    ):
        limit = '<limit lower="-50" upper="50" effort="1000" velocity="2"/>' if kind == "prismatic" else ""
        link = "" if child == "chassis" else f'<link name="{child}">{inertia(0.1, 0.01)}</link>'
        virtual += (
            f'{link}<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<axis xyz="{axis}"/>{limit}</joint>'
        )
        parent = child
    text = MOBILE.format(virtual=virtual, inertia40=inertia(40, 1.5), inertia1=inertia(1, 0.02))
    path = tmp_path_factory.mktemp("urdf") / "cart.urdf"
    path.write_text(text)
    return str(path)


@pytest.fixture
def yard() -> Scene:
    """A floor with one wall, whose near face is the plane x = 2."""
    floor = Box("floor", planar_pose(0, 0, -0.05), (10.0, 10.0, 0.1))
    wall = Box("wall", planar_pose(2.1, 0, 1.0), (0.2, 6.0, 2.0))
    return Scene("yard", static=(floor, wall))


@pytest.fixture(autouse=True, scope="session")
def _one_thread():
    """Small tensors gain nothing from more threads, and lose much on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
