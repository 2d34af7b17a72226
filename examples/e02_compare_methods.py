"""2. Map one sequence with several methods and let frames that none of them saw be the judge.

    python -m examples.e02_compare_methods runs/recorded --out runs/e02

Prints a table and leaves slices.png, one slice a method. Where the true distances are known, `benchmarks.mapping`
compares more closely.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

import isdf
from isdf.datasets import open_sequence
from isdf.evaluation import RayScores, draw_rays, evaluate_rays, hold_out
from isdf.methods import Config
from isdf.runner import run_at_rate
from isdf.slice_geometry import slice_basis
from isdf.slices import draw_slice, estimate_up, slice_heights
from isdf.voxel import ExactConfig, FiestaConfig, KinectFusionConfig, VoxbloxConfig

CONFIGS: dict[str, Config] = {
    "default": isdf.MapperConfig(),
    "isdf": isdf.IsdfConfig(),
    "exact": ExactConfig(),
    "voxblox": VoxbloxConfig(),
    "fiesta": FiestaConfig(),
    "kinectfusion": KinectFusionConfig(),
}


@dataclass(frozen=True)
class CompareMethods:
    """Map a sequence with several methods, each in the same CPU time, and judge them by frames held out."""

    sequence: tyro.conf.Positional[Path]
    """A recorded folder, or any other layout that `isdf map` reads."""
    out: Path
    """Folder for the picture."""
    methods: tuple[str, ...] = ("default", "isdf", "exact")
    """Some of default, isdf, exact, voxblox, fiesta, kinectfusion."""
    cpu_per_second: float = 1.0
    """CPU seconds that a method has for each second of sequence."""
    rays: int = 2000
    """Measured rays to judge by."""


def main(options: CompareMethods) -> dict[str, RayScores]:
    """Map and judge; returns the scores by method."""
    torch.set_num_threads(1)
    unknown = sorted(set(options.methods) - set(CONFIGS))
    if unknown:
        raise SystemExit(f"there are no methods {unknown}; choose from {', '.join(CONFIGS)}")
    sequence = open_sequence(options.sequence)
    mapped, held = hold_out(sequence, every=min(10, len(sequence)))
    rays = draw_rays(held, options.rays, seed=0)
    fields: dict[str, Any] = {}
    scores: dict[str, RayScores] = {}
    for name in tqdm(options.methods, desc="mapping", unit=" method", disable=None):
        mapper, _ = run_at_rate(mapped, CONFIGS[name], options.cpu_per_second, lambda *_: None)
        fields[name] = mapper.field()
        scores[name] = evaluate_rays(fields[name], rays)
    print(f"{'method':14}{'median error':>14}{'within 5 cm':>14}{'free called solid':>20}{'too far':>10}")
    for name, s in scores.items():
        print(
            f"{name:14}{100 * s.median_error:11.1f} cm{s.within:14.1%}{s.blocked:20.2%}{s.overestimated:10.2%}"
        )
    draw(options, fields, sequence.poses)
    return scores


def draw(options: CompareMethods, fields: dict[str, Any], poses: Any) -> None:
    """One slice a method, at the same height."""
    up, first = estimate_up(poses), next(iter(fields.values()))
    height = slice_heights(first, up, count=1)[0]
    across = first.bounds.numpy() @ slice_basis(up).T
    tall = abs((across[1] - across[0])[1] / (across[1] - across[0])[0])
    figure = Figure(figsize=(4.5 * len(fields) + 1, 4.5 * tall + 1), layout="constrained")
    panels = figure.subplots(1, len(fields), squeeze=False)[0]
    for axes, (name, field) in zip(panels, fields.items(), strict=True):
        image = draw_slice(axes, field, height, up, poses, bounds=first.bounds, spacing=0.03)
        axes.set_title(f"{name}, height {height:.2f} m")
    figure.colorbar(image, ax=list(panels), label="signed distance [m]", shrink=0.8)
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "slices.png", dpi=100)


if __name__ == "__main__":
    chosen = tyro.cli(CompareMethods, description=__doc__)
    main(chosen)
    print(f"picture: {chosen.out / 'slices.png'}")
