"""1. Fit a signed distance field to a recorded sequence, ask it, and draw a slice of it.

    python -m examples.record --out runs/recorded
    python -m examples.e01_fit_field runs/recorded --out runs/e01

Leaves map.safetensors, slice.png and mesh.ply. In a notebook the last line of a cell does for a picture: `mapper`,
`field` and `field.plot_slice(0.5)` show themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tqdm import tqdm

import isdf
from isdf.datasets import open_sequence
from isdf.meshing import zero_level_mesh


@dataclass(frozen=True)
class FitField:
    """Fit a field to a recorded sequence."""

    sequence: tyro.conf.Positional[Path]
    """A recorded folder, or any other layout that `isdf map` reads."""
    out: Path
    """Folder for the map and the pictures."""
    height: float | None = None
    """Of the slice [m]; by default half way up."""
    every: int = 1
    """Use one frame in so many."""


def main(options: FitField) -> isdf.LatticeField:
    """Fit, ask, draw; returns the field."""
    torch.set_num_threads(1)
    sequence = open_sequence(options.sequence)
    mapper = isdf.Mapper()
    for index in tqdm(range(0, len(sequence), options.every), desc="mapping", unit=" frames", disable=None):
        try:
            mapper.integrate(sequence[index])
        except isdf.FrameError as error:  # no depth, or the tracker lost the camera: a live system goes on
            tqdm.write(f"frame {index} passed over: {error}")
    mapper.refresh()  # write down what came in since the last time
    field = mapper.field()  # a snapshot: it does not change when mapping goes on
    print(mapper, field, sep="\n")

    # A metre and two before the last camera; confidence tells how likely a distance is right to 5 cm.
    T = torch.from_numpy(sequence.poses[-1]).float()
    points = T[:3, 3] + torch.tensor([[1.0], [2.0]]) * T[:3, 2]
    distance, gradient = field.distance_and_gradient(points)
    for row in zip(points, distance, gradient, field.confidence(points), strict=True):
        where, how_far, away, sure = (value.numpy().round(2) for value in row)
        print(
            f"at {where} m: {how_far:.2f} m to the nearest surface, away along {away}, confidence {sure:.2f}"
        )

    options.out.mkdir(parents=True, exist_ok=True)
    mapper.save(options.out / "map.safetensors")  # isdf.load_map reads it, `isdf export` converts it
    field.plot_slice(options.height, poses=sequence.poses).savefig(options.out / "slice.png")
    zero_level_mesh(field, 0.05).export(options.out / "mesh.ply")
    return field


if __name__ == "__main__":
    chosen = tyro.cli(FitField, description=__doc__)
    main(chosen)
    print(f"pictures and map: {chosen.out}")
