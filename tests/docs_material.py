"""What the pages of the documentation expect to find: small stand-ins for a user's own recordings and files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from isdf import DepthFrame
from isdf.datasets import SequenceWriter
from tests.isdf.rooms import furnished_orbit

URDF = """<robot name="r">
<link name="base"><collision><geometry><box size="0.3 0.2 0.1"/></geometry></collision></link>
<link name="arm"><collision><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.03" length="0.4"/></geometry>
</collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def recorded(folder: Path, name: str = "recorded") -> None:
    """A short recording in runs/recorded."""
    frames = furnished_orbit(12)
    writer = SequenceWriter(folder / "runs" / name, frames[0].camera, fps=10.0)
    for frame in frames:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())


def office(folder: Path) -> None:
    """The same in runs/office."""
    recorded(folder, "office")


def urdf(folder: Path) -> None:
    """A robot of two links in my_robot.urdf."""
    (folder / "my_robot.urdf").write_text(URDF)


def spheres(folder: Path) -> None:
    """Spheres of the Z1 in spheres.yaml: rows along each hull, made at once where a fit takes a minute."""
    from robots import SphereSet, save_spheres
    from robots.link_geometry import collision_pieces
    from robots.mesh_paths import example_robot_data

    pieces = collision_pieces(example_robot_data() / "z1_description/urdf/z1.urdf")
    rows = {link: np.concatenate([_row(*piece.bounds) for piece in held]) for link, held in pieces.items()}
    untested = {frozenset((a, b)) for a in rows for b in rows if a != b}
    save_spheres(folder / "spheres.yaml", SphereSet(rows, ignored_pairs=frozenset(untested)))


def _row(low: np.ndarray, high: np.ndarray, count: int = 6) -> np.ndarray:
    """Spheres (count, 4) whose union covers a box."""
    along, size = int((high - low).argmax()), high - low
    radius = 0.5 * np.sqrt(size @ size - size[along] ** 2 + (size[along] / count) ** 2)
    centres = np.tile((low + high) / 2, (count, 1))
    centres[:, along] = low[along] + size[along] * (np.arange(count) + 0.5) / count
    return np.column_stack([centres, np.full(count, radius)])


def bag(folder: Path) -> None:
    """A ROS 2 bag in my_bag: depth images, their camera_info and the camera's poses."""
    from tests.isdf.test_rosbag_reader import DEPTH, BagWriter

    frames: tuple[DepthFrame, ...] = furnished_orbit(12)
    with BagWriter(folder / "my_bag", ros2=True) as writer:
        writer.info(camera=frames[0].camera)
        for frame in frames:
            writer.image(frame.time, frame.depth.numpy(), topic=DEPTH)
            writer.pose_stamped("/camera/pose", frame.time, frame.T_world_camera.to(torch.float64).numpy())
