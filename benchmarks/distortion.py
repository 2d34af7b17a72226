"""How well the default map learns its camera's low-frequency depth distortion, and what that is worth.

    python -m examples.record_sequences --out runs/sequences
    python -m benchmarks.distortion --sequences runs/sequences --data $ISDF_DATA_DIR

Synthetic sequences tell the truth: the mean ratio of their noisy to their noise-free depth at every pixel. A line each:
its root mean square, and of what is left when the map's own estimate is taken off it, after so many seconds [% of the
depth]; CPU time of an image [ms].

Real sequences do not, but their held-out frames do: a map of nine tenths of a sequence predicts them better when they
are freed of the distortion that the map has learned from the others. A line each: the median error of the depth that is
predicted [cm] by a map that learns none, as measured; by one that does, as measured; and by the same, freed of it.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.runs import REAL_FPS
from benchmarks.sequences import chosen
from isdf import DepthFrame, Mapper, MapperConfig
from isdf.datasets import DepthSequence, RecordedSequence, open_sequence
from isdf.evaluation import draw_rays, evaluate_rays, hold_out
from isdf.mapping.distortion import Distortion
from isdf.runner import run_at_rate

# Times [s] at which the estimate is compared with the truth, and every how many frames it learns.
TIMES, STRIDE = (2.0, 4.0, 8.0, 16.0), 2
# Ratios farther than this from 1 are edges, where a pixel measures what is beside it.
FAR = 0.1


@dataclass(frozen=True)
class Options:
    """Learn and compare."""

    sequences: Path = Path("runs/sequences")
    """Folder of recorded sequences with noise_free/."""
    only: tuple[str, ...] = ()
    """Names of the sequences to take; all if empty."""
    data: Path | None = None
    """Folder of the real sequences; without it they are left out."""


class Freed:
    """A sequence whose images are freed of a distortion that was learned."""

    def __init__(self, sequence: DepthSequence, distortion: Distortion) -> None:
        self._sequence, self._distortion = sequence, distortion
        self.folder, self.camera = sequence.folder, sequence.camera
        self.poses, self.fps = sequence.poses, sequence.fps

    def __len__(self) -> int:
        return len(self._sequence)

    def __getitem__(self, i: int) -> DepthFrame:
        frame = self._sequence[i]
        relative = self._distortion.relative(frame.camera.height, frame.camera.width)
        return replace(frame, depth=frame.depth / torch.from_numpy(1 + relative).float())


def true_distortion(noisy: DepthSequence, exact: DepthSequence) -> np.ndarray:
    """Mean relative error (h, w) of the depth at every pixel, less its mean."""
    total, count = np.zeros((2, noisy.camera.height, noisy.camera.width))
    for i in range(0, len(noisy), STRIDE):
        measured, true = noisy[i].depth.numpy(), exact[i].depth.numpy()
        ratio = measured / np.maximum(true, 1e-3) - 1
        good = (measured > 0) & (true > 0) & (np.abs(ratio) < FAR)
        total += np.where(good, ratio, 0)
        count += good
    out = total / np.maximum(count, 1)
    return np.asarray(out - out.mean())


def synthetic(folder: Path) -> str:
    """A sequence's line."""
    noisy = RecordedSequence(folder)
    truth = true_distortion(noisy, RecordedSequence(folder / "noise_free"))
    config = MapperConfig()
    found, left, spent = Distortion(config.distortion), [], 0.0
    indices = range(0, len(noisy), STRIDE)
    for i in indices:
        frame = noisy[i]
        depth = np.where(frame.depth.numpy() <= config.max_depth, frame.depth.numpy(), np.float32(0))
        camera = frame.camera
        before = time.process_time()
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        found.correct(depth, intrinsics)
        found.learn(depth, intrinsics, frame.T_world_camera.numpy())
        spent += time.process_time() - before
        if len(left) < len(TIMES) and i >= TIMES[len(left)] * noisy.fps:
            left.append(100 * np.std(found.relative(*depth.shape) - truth))
    after = " ".join(f"{part:7.2f}" for part in left)
    return f"{100 * truth.std():7.2f} {after} {1e3 * spent / len(indices):7.1f}"


def real(name: str, data: Path) -> str:
    """A real sequence's line."""
    mapped, held = hold_out(open_sequence(data / name, REAL_FPS[name]))
    plain, learned = (_mapped(mapped, sigma) for sigma in (0.0, MapperConfig().distortion))
    parts = ((plain, held), (learned, held), (learned, Freed(held, learned.distortion)))
    medians = [
        evaluate_rays(mapper.field(), draw_rays(frames, 20_000, seed=0)).median_error
        for mapper, frames in parts
    ]
    return " ".join(f"{100 * median:7.2f}" for median in medians)


def _mapped(sequence: DepthSequence, sigma: float) -> Mapper:
    mapper, _ = run_at_rate(sequence, MapperConfig(distortion=sigma), 1.0, lambda *_: None)
    assert isinstance(mapper, Mapper)
    return mapper


def main(options: Options) -> None:
    """Print the lines."""
    torch.set_num_threads(1)
    columns = ["rms", *(f"{t:g} s" for t in TIMES), "ms"]
    print(f"{'sequence':>22} " + " ".join(f"{c:>7}" for c in columns))
    for name in chosen(options.sequences, options.only):
        print(f"{name:>22} {synthetic(options.sequences / name)}", flush=True)
    if options.data is None:
        return
    print(f"{'real sequence':>22} " + " ".join(f"{c:>7}" for c in ("none", "learned", "freed")))
    for name in REAL_FPS:
        print(f"{name:>22} {real(name, options.data)}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
