"""5. The exact field of a scene of meshes: draw it, compare a map with it, plan in it.

    python -m examples.e05_mesh_truth scene.obj --out runs/e05
    python -m examples.e05_mesh_truth house.urdf --out runs/e05

Without a file it makes a table with a torus on it. Leaves slice.png.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro

import isdf
import planning
import robots
from robots.simulation import MeshField


@dataclass(frozen=True)
class MeshTruth:
    """Make the exact distance field of meshes and plan in it."""

    scene: tyro.conf.Positional[Path | None] = None
    """A mesh file of any kind that trimesh reads, z up and in metres, or a static URDF."""
    out: Path = Path("runs/e05")
    """Folder for the picture."""
    scale: float = 1.0
    """Metres in a unit of a mesh file."""
    height: float | None = None
    """Of the slice [m]; by default half way up."""


def table() -> MeshField:
    """A table before a robot at the origin, and a torus standing on it."""
    legs = [(x, y) for x in (0.45, 0.95) for y in (-0.4, 0.4)]
    boxes = [trimesh.creation.box((0.04, 0.04, 0.1)).apply_translation((x, y, 0.05)) for x, y in legs]
    board = trimesh.creation.box((0.6, 0.9, 0.04)).apply_translation((0.7, 0.0, 0.12))
    torus = trimesh.creation.torus(0.2, 0.04)
    turned = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0))
    return MeshField([board, *boxes, torus.apply_transform(turned).apply_translation((0.45, 0.0, 0.38))])


def read(options: MeshTruth) -> MeshField:
    """The field that the options name."""
    if options.scene is None:
        return table()
    if options.scene.suffix == ".urdf":
        return MeshField.from_urdf(options.scene)
    return MeshField.read(options.scene, scale=options.scale)


def main(options: MeshTruth) -> MeshField:
    """Measure, draw, plan; returns the field."""
    torch.set_num_threads(1)
    truth = read(options)
    low, high = truth.bounds
    points = low - 0.3 + (high - low + 0.6) * torch.rand(20_000, 3)
    truth.distance(points[:10])  # compiles
    started = time.process_time()
    distance = truth.distance(points)
    spent = 1e6 * (time.process_time() - started) / len(points)
    print(
        f"bounds {low.tolist()} to {high.tolist()} m; {spent:.1f} us a point; {(distance < 0).sum()} inside"
    )

    # A grid of it answers in a tenth of the time, and errs by what trilinear interpolation does.
    grid = isdf.bake(truth, truth.bounds, spacing=0.03, padding=0.3)
    error = (grid.distance(points) - distance).abs()
    print(f"{grid}: off by {1000 * error.mean():.1f} mm in the mean, {1000 * error.max():.0f} mm at most")

    options.out.mkdir(parents=True, exist_ok=True)
    region = truth.bounds + 0.3 * torch.tensor([[-1.0], [1.0]])
    isdf.plot_slice(truth, options.height, bounds=region).savefig(options.out / "slice.png")

    if options.scene is None:  # the hand from one side of the torus to the other
        robot = robots.load("panda")
        low = robot.named["ready"].clone()
        low[1], low[3] = 0.0, -2.2  # the hand over the table
        start, goal = low.clone(), low.clone()
        start[0], goal[0] = -0.9, 0.9
        print(planning.Planner(robot).plan(start, goal, truth))
    return truth


if __name__ == "__main__":
    chosen = tyro.cli(MeshTruth, description=__doc__)
    main(chosen)
    print(f"picture: {chosen.out / 'slice.png'}")
