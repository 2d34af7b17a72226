"""Train the network that guesses distances where nothing was seen, on randomly furnished rooms.

    python -m benchmarks.train_completion data --out runs/completion
    python -m benchmarks.train_completion train runs/completion --out isdf/data/completion.safetensors

`data` has the default map fuse noisy images of a camera that moves about in each room in one of the ways of
`benchmarks.camera_ways`. At a few moments it notes what the network would see then, with the true distances and how
often each place was looked at. No room of `robots.simulation.scenes` takes part.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from safetensors.torch import load_file, save_file

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.camera_ways import PERIOD, camera_way
from benchmarks.random_rooms import RandomRoom, depth_image, random_room
from isdf import DepthFrame, Mapper, PinholeCamera
from isdf.evaluation.metrics import UNSAFE
from isdf.mapping.completion import CompletionNet, features
from isdf.mapping.refresh import Surroundings, middle_of_guesses, surroundings
from isdf.mapping.values import LEAST_OF_ERROR
from robots.simulation import DepthNoise, DepthNoiseConfig

SPACING = 0.16
# Widths of images [px], and how often each is taken.
WIDTHS = {160: 0.7, 80: 0.3}
# Share of cameras that measure without any error, as those of many simulators do.
WITHOUT_NOISE = 0.2
UP = np.array([0.0, 0.0, 1.0])
# Windows of one way, at most.
MOMENTS = 5
# Points of an image that tell how often each place was looked at.
DRAWN = 500
# How much visible places count in the loss, compared with all.
LOOKS_COUNT = 4.0
# How much 1 - cos between the guess's gradient and the true one counts, compared with a metre of error.
GRADIENT_COUNTS = 0.075
# Truth is asked for this far into walls and floor [m]; beyond them there is nothing to know.
INTO_WALLS = 0.3
# Nothing is expected to err by less than this [m].
LEAST_EXPECTED = 0.01
# The learning rate rises for so many steps.
WARM_UP = 300
# Below this gap between the bounds [m] there is nothing to guess.
LEAST_GAP = 0.02


@dataclass(frozen=True)
class Data:
    """Make training windows."""

    out: Path
    """Folder for the windows."""
    rooms: int = 600
    """How many rooms; each gives several windows."""
    seed: int = 0
    """Of the first room."""

    def run(self) -> None:
        """One file a window."""
        self.out.mkdir(parents=True, exist_ok=True)
        for number in range(self.seed, self.seed + self.rooms):
            for index, (kind, w) in enumerate(windows(np.random.default_rng(number))):
                tensors = {"x": w.x.half(), "truth": w.truth.half(), "mask": w.mask, "looks": w.looks.half()}
                save_file(tensors, self.out / f"{number:05d}_{kind}_{index}.safetensors")


@dataclass(frozen=True)
class Train:
    """Fit the network."""

    data: tyro.conf.Positional[Path]
    """Folder that `data` wrote; files that arrive during training are used too."""
    out: Path
    """The weights."""
    minutes: float = 60.0
    """How long to train."""
    batch: int = 4
    """Windows a step."""
    rate: float = 6e-4
    """Greatest learning rate."""
    start: Path | None = None
    """Weights to go on from."""
    keep: float = 0.0
    """Share of the weights to start from in those that are written: of rooms unlike those of the windows the mean of
    both may know more."""
    judge: bool = False
    """Only judge the weights to start from."""

    def __post_init__(self) -> None:
        """Refuse a share that is none, or is of weights that are not there to the end."""
        if not 0 <= self.keep < 1 or (self.keep > 0 and self.start is None):
            raise SystemExit(
                f"--keep must be at least 0 and below 1, and above 0 only with --start, got {self.keep:g}"
            )
        if self.keep > 0 and self.start is not None and self.start.resolve() == self.out.resolve():
            raise SystemExit("--keep needs the weights of --start to the end: give another file as --out")

    def run(self) -> None:
        """Every 25th room is left out and tells the error of windows never trained on."""
        torch.manual_seed(0)
        net = CompletionNet().to(memory_format=torch.channels_last_3d)
        if self.start is not None:
            net.load_state_dict(weights_of(self.start))
        if self.judge:
            print(judged(net, self.files(held=True)))
            return
        optimiser = torch.optim.AdamW(net.parameters(), lr=self.rate, weight_decay=1e-3)
        rng, begin, step, running = np.random.default_rng(0), time.time(), 0, 0.0
        while (spent := (time.time() - begin) / 60 / self.minutes) < 1:
            for group in optimiser.param_groups:
                group["lr"] = self.rate * min(1, (step + 1) / WARM_UP) * (0.5 + 0.5 * np.cos(np.pi * spent))
            optimiser.zero_grad()
            files = self.files(held=False)
            # One by one, for windows are of several sizes.
            for file in rng.choice(files, self.batch):  # type: ignore[arg-type]
                loss, error = score(net, turned(load(file), rng))
                (loss / self.batch).backward()
                running += 0.01 * (error - running)
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            step += 1
            if step % 500 == 0 or step == 10:
                print(f"step {step} of {len(files)} windows: error {100 * running:.1f} cm; held out")
                print(judged(net, self.files(held=True)), flush=True)
                self.save(net)
        self.save(net)
        net.load_state_dict(weights_of(self.out))
        print(f"as written:\n{judged(net, self.files(held=True))}", flush=True)

    def files(self, held: bool) -> list[Path]:
        """Windows to learn from, or those held out."""
        return [f for f in sorted(self.data.glob("*.safetensors")) if (int(f.name[:5]) % 25 == 0) == held]

    def save(self, net: CompletionNet) -> None:
        """Write the weights, drawn back towards those that training began from if these are to `keep` a share."""
        weights = net.state_dict()
        if self.start is not None and self.keep > 0:
            begun = weights_of(self.start)
            weights = {name: torch.lerp(value, begun[name], self.keep) for name, value in weights.items()}
        self.out.parent.mkdir(parents=True, exist_ok=True)
        save_file({name: value.half().contiguous() for name, value in weights.items()}, self.out)


def weights_of(path: Path) -> dict[str, torch.Tensor]:
    """Weights from a file, in single precision."""
    return {name: value.float() for name, value in load_file(path).items()}


def load(path: Path) -> Window:
    """One window."""
    t = load_file(path)
    return Window(t["x"].float(), t["truth"].float(), t["mask"], t["looks"].float())


def turned(window: Window, rng: np.random.Generator) -> Window:
    """The window mirrored and turned about the vertical at random."""
    x, planes = window.x.clone(), [window.truth, window.mask, window.looks]
    for axis in range(2):
        if rng.random() < 0.5:
            x, planes = x.flip(axis + 1), [p.flip(axis) for p in planes]
            x[4 + axis] = -x[4 + axis]
    if rng.random() < 0.5:
        x, planes = x.transpose(1, 2).clone(), [p.transpose(0, 1) for p in planes]
        x[4:6] = x[4:6].flip(0)
    return Window(x, *planes)


def predicted(net: CompletionNet, window: Window) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Distances, logarithm of the expected error over the gap, and the gap [m], each (nx, ny, nz)."""
    x = window.x[None].to(memory_format=torch.channels_last_3d)
    # Where the processor can, training in half precision takes a fifth of the time.
    able = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    half = able and torch.is_grad_enabled()
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=half):
        share, width = (answer[0] for answer in net(x))
    upper, lower = window.x[0], window.x[1]
    # The map knows that free space is not inside anything.
    lower = torch.where(window.x[2] > 0, lower.clamp(min=0), lower)
    gap = (upper - lower).clamp(min=0)
    return upper - gap * share, width, gap


def score(net: CompletionNet, window: Window) -> tuple[torch.Tensor, float]:
    """Loss and mean error [m] where there is something to guess.

    The loss is the likelihood of a Laplace distribution: its location learns the median, its width the error. To it
    comes how far the gradient is turned away from the true one.
    """
    f, width, gap = predicted(net, window)
    here = window.mask & (gap > LEAST_GAP)
    error = (f - window.truth).abs()[here]
    expected = gap[here] * width[here].exp() + LEAST_EXPECTED
    away, known = turned_away(f, window)
    known &= here
    loss = (counts(window, here) * (4 * error + 0.1 * (error / expected + expected.log()))).sum()
    loss += 4 * GRADIENT_COUNTS * (counts(window, known) * away[known]).sum()
    return loss, float(error.detach().mean()) if len(error) else 0.0


def counts(window: Window, here: torch.Tensor) -> torch.Tensor:
    """How much each of the nodes counts, which are those of a mask (nx, ny, nz).

    Space that was looked through counts as much as all there is, by how often it was looked at.
    """
    looks = window.looks[here]
    return 1 / max(1, len(looks)) + LOOKS_COUNT * looks / window.looks.sum().clamp(min=1)


def turned_away(f: torch.Tensor, window: Window) -> tuple[torch.Tensor, torch.Tensor]:
    """1 - cos between the gradients of distances f (nx, ny, nz) and the true ones, and where that is known.

    Gradients are differences to the next node along each axis.
    """
    known = window.mask.clone()
    for axis in range(3):
        known &= window.mask.roll(-1, axis)
        known.select(axis, -1)[:] = False
    ours, true = (torch.stack([d.roll(-1, axis) - d for axis in range(3)]) for d in (f, window.truth))
    # The small number keeps slopes of flat places from being divided by nothing.
    cos = (ours * true).sum(dim=0) / (ours.square().sum(dim=0) * true.square().sum(dim=0) + 1e-8).sqrt()
    return 1 - cos, known


def mean(values: torch.Tensor, weight: torch.Tensor) -> float:
    """Weighted mean, 0 where nothing weighs."""
    return float((weight * values).sum() / weight.sum().clamp(min=1))


@torch.no_grad()
def judged(net: CompletionNet, files: list[Path]) -> str:
    """Errors [cm] of the upper bound, of the network and of what the map makes of it, where they are judged.

    In visible space by how often it was looked at, and in space not looked at, by kind of way; then, of visible places,
    how far the gradient is turned away, and what share is over-estimated by more than 5 cm.
    """
    rows: dict[str, list[list[float]]] = {}
    for file in files:
        window = load(file)
        f, width, gap = predicted(net, window)
        upper, free = window.x[0], window.x[2] > 0
        kept = torch.where(free & (upper - f < LEAST_OF_ERROR * gap * width.exp()), upper, f)
        unseen = (window.mask & (window.x[3] > 0) & (window.truth > 0)).float()
        visible = window.looks * window.mask
        row = []
        for weight in (visible, unseen):
            row += [100 * mean((g - window.truth).abs(), weight) for g in (upper, f, kept)]
        for g in (upper, kept):
            away, known = turned_away(g, window)
            row.append(mean(away, visible * known))
        row += [100 * mean((g - window.truth > UNSAFE).float(), visible) for g in (upper, kept)]
        rows.setdefault(file.name.split("_")[1], []).append(row)
    lines = []
    for kind, values in sorted(rows.items()):
        m = np.mean(values, axis=0)
        lines.append(
            f"  {kind:>6} ({len(values):3d}): visible {m[0]:.2f} -> {m[1]:.2f} ({m[2]:.2f} in the map), "
            f"unseen {m[3]:.1f} -> {m[4]:.1f}, 1 - cos {m[6]:.4f} -> {m[7]:.4f}, over {m[8]:.1f} -> {m[9]:.1f} %"
        )
    return "\n".join(lines)


@dataclass
class Window:
    """What the network would see at one moment, and what would be right.

    Args:
        x: features (8, nx, ny, nz).
        truth: distances (nx, ny, nz) [m].
        mask: where they are known.
        looks: how often a point of the views so far, drawn as maps are judged by them, is closest to a node.
    """

    x: torch.Tensor
    truth: torch.Tensor
    mask: torch.Tensor
    looks: torch.Tensor


class Fusing(Mapper):
    """The default map without distances: it fuses, and that is all."""

    def _guess(self, eye: np.ndarray) -> None: ...

    def refresh(self) -> None:
        """Nothing."""
        self._viewed = None


def windows(rng: np.random.Generator) -> Iterator[tuple[str, Window]]:
    """The kind of a camera's way through a random room, and windows of a few moments of it."""
    room = random_room(rng)
    kind, poses = camera_way(rng, room)
    if len(poses) < 4:
        return
    width = int(rng.choice(list(WIDTHS), p=list(WIDTHS.values())))
    angle = float(np.radians(rng.choice([58, rng.uniform(50, 88)])))
    camera = PinholeCamera.from_fov(width, width * 3 // 4, angle)
    far = float(rng.choice([4.0, 6.0, 10.0, 10.0]))
    noise = DepthNoise(DepthNoiseConfig(distortion_seed=int(rng.integers(1000)), max_range=far))
    noisy = rng.random() >= WITHOUT_NOISE
    mapper, drawn = Fusing(), []
    moments = {int(rng.integers(1, 6)), len(poses)} | {
        int(n) for n in rng.integers(3, len(poses) + 1, MOMENTS - 2)
    }
    for count, T in enumerate(poses, start=1):
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        depth = depth_image(*room.solids, T, intrinsics, camera.height, camera.width, 0.1, far)
        measured = torch.from_numpy(noise(depth, rng) if noisy else depth)
        if not measured.any():
            continue
        mapper.integrate(DepthFrame(measured, torch.from_numpy(T), camera, time=PERIOD * count))
        drawn.append(visible_points(rng, depth, T, camera))
        if count not in moments:
            continue
        lattice, bounds = mapper.lattice, mapper.bounds.numpy().astype(float)
        middle = middle_of_guesses(T[:3, 3], UP, bounds, lattice.spacing)
        around = surroundings(lattice, mapper.bricks, middle, UP)
        if around is not None:
            points = np.round(np.concatenate(drawn) / mapper.lattice.spacing).astype(np.int64) - around.corner
            truth, mask = truth_of(room, around)
            looks = count_in(points, mask.shape)
            yield kind, Window(features(around.proven), *(torch.from_numpy(a) for a in (truth, mask, looks)))


def visible_points(
    rng: np.random.Generator, depth: np.ndarray, T: np.ndarray, camera: PinholeCamera
) -> np.ndarray:
    """Points (n, 3) [m] between the camera and a little behind what it sees, as evaluation draws them."""
    v, u = np.nonzero(depth)
    if len(v) == 0:
        return np.zeros((0, 3))
    chosen = rng.integers(len(v), size=DRAWN)
    v, u = v[chosen], u[chosen]
    z = 0.1 + rng.random(DRAWN) * depth[v, u]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(DRAWN)], axis=1)
    return (rays * z[:, None]) @ T[:3, :3].T + T[:3, 3]


def count_in(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """How many of points (n, 3), in nodes, are at each node."""
    inside = points[((points >= 0) & (points < shape)).all(axis=1)]
    return np.bincount(np.ravel_multi_index(tuple(inside.T), shape), minlength=int(np.prod(shape))).reshape(
        shape
    )


def truth_of(room: RandomRoom, around: Surroundings) -> tuple[np.ndarray, np.ndarray]:
    """True distances [m] of the window's nodes, and which of them lie in the room or just inside its walls."""
    shape = around.proven.upper.shape
    nodes = SPACING * (around.corner + np.argwhere(np.ones(shape, dtype=bool)))
    mask = room.inside(nodes, INTO_WALLS)
    truth = np.zeros(len(nodes), dtype=np.float32)
    truth[mask] = room.distance(nodes[mask])
    return truth.reshape(shape), mask.reshape(shape)


Command = Annotated[Data, tyro.conf.subcommand("data")] | Annotated[Train, tyro.conf.subcommand("train")]

if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(Command).run()  # type: ignore[arg-type]
