"""Sphere sets against one another: fit to the same hulls, and MotionBenchMaker's starts and goals that they forbid.

    python -m benchmarks.spheres            # ours, and the published sets where ISDF_DATA_DIR is set

Overshoot and coverage are measured by one function on the convex hulls of the ready-made robots' collision meshes.
A start or goal counts as forbidden where a sphere touches an obstacle or a tested link pair touches itself, with the
fingers as the problem has them; spheres of the body that does not move are left out against obstacles.
"""

from __future__ import annotations

import gzip
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import robots
from robots.checking import body_fits
from robots.sphere_fitting import SphereFit

PUBLISHED = {
    "panda": ("panda_vamp.json", "curobo_franka.yml", "franka_robometrics.yml"),
    "fetch": ("fetch_vamp.json", "fetch_whole_body.json"),
    "ur5": ("ur5_vamp.json",),
}


def read_published(path: Path, robot: robots.Robot) -> robots.Robot:
    """A robot with a published sphere set; links that the robot lacks are left out."""
    if path.suffix == ".json":
        rows = {link: np.array(spheres) for link, spheres in json.loads(path.read_text()).items() if spheres}
        spheres = robots.SphereSet(rows)
    else:
        spheres = robots.load_spheres(path)
    return robot.with_spheres(
        replace(spheres.restricted_to(robot.tree.links), ignored_pairs=robot.sphere_set.ignored_pairs)
    )


def summary(fits: Sequence[SphereFit]) -> tuple[float, float, float, float]:
    """Greatest uncovered distance, and mean, greatest 95th percentile and greatest overshoot over bodies [mm]."""
    rows = np.array([(f.max_uncovered, f.overshoot_mean, f.overshoot_p95, f.overshoot_max) for f in fits])
    counts = np.array([len(f.spheres) for f in fits])
    mean = float((rows[:, 1] * counts).sum() / counts.sum())
    return 1e3 * rows[:, 0].max(), 1e3 * mean, 1e3 * rows[:, 2].max(), 1e3 * rows[:, 3].max()


def obstacle_distance(points: Tensor, obstacles: Sequence[Mapping[str, Any]]) -> Tensor:
    """Signed distance (...,) [m] of points (..., 3) to MotionBenchMaker's boxes and cylinders."""
    nearest = torch.full(points.shape[:-1], torch.inf)
    for obstacle in obstacles:
        x, y, z, w = obstacle["quat_xyzw"]
        rotation = torch.tensor(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        local = (points - torch.tensor(obstacle["position"])) @ rotation
        if obstacle["type"] == "box":
            beyond = local.abs() - torch.tensor(obstacle["dimensions"]) / 2
        else:
            height, radius = obstacle["dimensions"]
            beyond = torch.stack([local[..., :2].norm(dim=-1) - radius, local[..., 2].abs() - height / 2], -1)
        distance = beyond.clamp(min=0).norm(dim=-1) + beyond.amax(-1).clamp(max=0)
        nearest = torch.minimum(nearest, distance)
    return nearest


def forbidden(robot: robots.Robot, problem: Mapping[str, Any], key: str) -> bool:
    """Whether the spheres put a problem's `start` or `goal` in collision."""
    values = dict(zip(problem["joints"], problem[key], strict=True))
    q = torch.tensor([float(values[joint]) for joint in robot.joint_names])
    centres, radii = robot.spheres(q)
    static = set(robot.tree.rigid_bodies(robot.tree.links)[0])
    moves = torch.tensor([link not in static for link in robot.sphere_links])
    gap = (obstacle_distance(centres[moves], problem["obstacles"]) - radii[moves]).min()
    first, second = robot.self_collision_pairs.unbind(-1)
    own = (centres[first] - centres[second]).norm(dim=-1) - radii[first] - radii[second]
    return bool(gap < 0) or bool((own < 0).any())


def main() -> None:
    """Print the table."""
    data = os.environ.get("ISDF_DATA_DIR")
    if data is None:
        print("ISDF_DATA_DIR is not set: only our own sets, no problems")
    print(
        f"{'set':32}{'spheres':>8}{'uncovered':>11}{'overshoot mean':>16}{'95 %':>7}{'max':>7} [mm]  forbidden"
    )
    for name in ("panda", "fetch", "ur5", "tiago"):
        try:
            ours = robots.load(name)
        except robots.RobotError as error:
            print(f"{name}: {error}")
            continue
        sets = {f"{name} (ours)": ours}
        problems: list[dict[str, Any]] = []
        if data is not None:
            sets |= {
                file: read_published(Path(data) / "spheres" / file, ours) for file in PUBLISHED.get(name, ())
            }
            path = Path(data) / "motionbenchmaker" / f"{name}_problems.json.gz"
            if path.is_file():
                with gzip.open(path) as stream:
                    problems = json.load(stream)["problems"]
        if problems and "panda_finger_joint1" in ours.held:
            opening = problems[0]["start_all"]["panda_finger_joint1"]
            sets = {k: r.with_fixed({"panda_finger_joint1": opening}) for k, r in sets.items()}
        for label, robot in sets.items():
            uncovered, mean, p95, most = summary(list(body_fits(robot).values()))
            wrong = "".join(
                f"{sum(forbidden(robot, p, key) for p in problems):5d} {key}s" for key in ("start", "goal")
            )
            print(
                f"{label:32}{len(robot.sphere_links):8d}{uncovered:11.1f}{mean:16.1f}{p95:7.1f}{most:7.1f}     "
                + (f"{wrong} of {len(problems)}" if problems else "-"),
                flush=True,
            )


if __name__ == "__main__":
    main()
