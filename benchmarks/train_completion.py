"""Train the network that guesses distances where nothing was seen, on randomly furnished rooms.

    python -m benchmarks.train_completion data --out runs/completion --rooms 400
    python -m benchmarks.train_completion train runs/completion --out isdf/data/completion.safetensors

`data` moves a camera about in each room in one of three ways (driving through, going round a piece of furniture,
looking down on one as a robot does that grasps), notes now and then what is proven of every node of a window about it,
and the true distances there. No room of `robots.simulation.scenes` takes part.
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

from benchmarks.random_rooms import RandomRoom, depth_image, random_room, scene_distance
from isdf.mapping.completion import CompletionNet, features
from isdf.mapping.evidence import gather, look_through

SPACING = 0.16
WINDOW = np.array([56, 56, 32])
IMAGE = (48, 64)
# Truth is asked for this far into walls and floor [m]; beyond them there is nothing to know.
INTO_WALLS = 0.3
# Below this gap between the bounds [m] there is nothing to guess.
LEAST_GAP = 0.02


@dataclass(frozen=True)
class Data:
    """Make training windows."""

    out: Path
    """Folder for the windows."""
    rooms: int = 400
    """How many rooms; each gives several windows."""
    seed: int = 0
    """Of the first room."""

    def run(self) -> None:
        """One file a window."""
        self.out.mkdir(parents=True, exist_ok=True)
        for number in range(self.seed, self.seed + self.rooms):
            rng = np.random.default_rng(number)
            for index, (x, truth, mask) in enumerate(windows(rng)):
                tensors = {"x": x.half(), "truth": truth.half(), "mask": mask}
                save_file(tensors, self.out / f"{number:05d}_{index}.safetensors")


@dataclass(frozen=True)
class Train:
    """Fit the network."""

    data: tyro.conf.Positional[Path]
    """Folder that `data` wrote; files that arrive during training are used too."""
    out: Path
    """The weights."""
    minutes: float = 20.0
    """How long to train."""
    batch: int = 2
    """Windows a step."""
    start: Path | None = None
    """Weights to go on from."""

    def run(self) -> None:
        """Every 50th room is left out and reports the error of windows never trained on."""
        torch.manual_seed(0)
        net = CompletionNet()
        if self.start is not None:
            net.load_state_dict({k: v.float() for k, v in load_file(self.start).items()})
        optimiser = torch.optim.AdamW(net.parameters(), lr=2e-3, weight_decay=1e-3)
        rng, begin, step, running = np.random.default_rng(0), time.time(), 0, 0.0
        while (spent := (time.time() - begin) / 60 / self.minutes) < 1:
            for group in optimiser.param_groups:
                group["lr"] = 2e-3 * min(1, (step + 1) / 50) * (0.5 + 0.5 * np.cos(np.pi * spent))
            files = sorted(self.data.glob("*.safetensors"))
            chosen = [f for f in rng.choice(files, self.batch) if int(f.name[:5]) % 50]
            if not chosen:
                continue
            x, truth, mask = (
                torch.stack(t) for t in zip(*[turned(load(f), rng) for f in chosen], strict=True)
            )
            loss, error, _ = score(net, x, truth, mask)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            running += 0.02 * (float(error) - running) if step else float(error)
            step += 1
            if step % 100 == 0:
                held = self.validate(net, [f for f in files if int(f.name[:5]) % 50 == 0])
                print(
                    f"step {step} of {len(files)} windows: error {100 * running:.1f} cm; held out {held}",
                    flush=True,
                )
                self.out.parent.mkdir(parents=True, exist_ok=True)
                save_file({k: v.half() for k, v in net.state_dict().items()}, self.out)

    def validate(self, net: CompletionNet, files: list[Path]) -> str:
        """Errors [cm] of the upper bound and of the network, in space not looked at and in space looked through."""
        rows = []
        with torch.no_grad():
            for file in files[:24]:
                x, truth, mask = (t[None] for t in load(file))
                _, _, f = score(net, x, truth, mask)
                for state in (3, 2):
                    here = mask & (x[:, state] > 0) & (truth > 0)
                    upper = x[:, 0][here]
                    rows.append(
                        [
                            float((upper - truth[here]).abs().mean()),
                            float((f[here] - truth[here]).abs().mean()),
                        ]
                    )
        table = 100 * np.nanmean(np.array(rows).reshape(-1, 4), axis=0)
        return "unseen {:.1f} -> {:.1f}, seen {:.2f} -> {:.2f}".format(*table)


def load(path: Path) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features, true distances and mask of one window."""
    tensors = load_file(path)
    return tensors["x"].float(), tensors["truth"].float(), tensors["mask"]


def turned(window: tuple[torch.Tensor, ...], rng: np.random.Generator) -> tuple[torch.Tensor, ...]:
    """The window mirrored and turned about the vertical at random."""
    x, truth, mask = window
    x = x.clone()
    for axis in range(2):
        if rng.random() < 0.5:
            x, truth, mask = x.flip(axis + 1), truth.flip(axis), mask.flip(axis)
            x[4 + axis] = -x[4 + axis]
    if rng.random() < 0.5:
        x, truth, mask = x.transpose(1, 2), truth.transpose(0, 1), mask.transpose(0, 1)
        x = x[[0, 1, 2, 3, 5, 4, 6, 7]]
    return x, truth, mask


def score(
    net: CompletionNet, x: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Loss, mean error [m] where there is something to guess, and the distances (b, nx, ny, nz) [m].

    The loss is the likelihood of a Laplace distribution: its location learns the median, its width the error.
    """
    share, log_width = net(x)
    upper, lower = x[:, 0], x[:, 1]
    gap = (upper - lower).clamp(min=0)
    f = upper - gap * share
    here = mask & (gap > LEAST_GAP)
    error = (f - truth).abs()[here]
    width = log_width[here] + gap[here].log()
    relative = error * torch.exp(-width.clamp(min=np.log(0.01)))
    loss = 4 * error.mean() + 0.1 * (relative + width).mean()
    return loss, error.mean().detach(), f.detach()


def windows(rng: np.random.Generator) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Features, truth and mask of a few moments of one camera's way through one room."""
    room = random_room(rng)
    solids = (room.kind, room.rotation, room.centre, room.parameters)
    poses = camera_way(rng, room, solids)
    if len(poses) < 4:
        return
    middle = np.mean([T[:3, 3] for T in poses], axis=0)
    middle[2] += rng.uniform(-0.5, 0.5)
    corner = np.round(middle / SPACING).astype(np.int64) - WINDOW // 2
    truth, mask = truth_of(room, solids, corner)
    fov = rng.uniform(np.radians(52), np.radians(88))
    fx = IMAGE[1] / 2 / np.tan(fov / 2)
    camera = (fx, fx, IMAGE[1] / 2 - 0.5, IMAGE[0] / 2 - 0.5)
    far = float(rng.choice([4.0, 5.0, 8.0, 12.0]))
    evidence, points = np.zeros(tuple(WINDOW), np.uint8), np.zeros((0, 3), np.float32)
    moments = {int(rng.integers(1, 5)), int(rng.integers(5, 14)), len(poses)}
    for count, T in enumerate(poses, start=1):
        depth = depth_image(*solids, T, camera, *IMAGE, 0.15, far)
        nothing = np.zeros(depth.shape, dtype=bool)  # came into free space
        look_through(
            evidence, corner, SPACING, np.zeros(3, np.int64), WINDOW, depth, nothing, 1, camera, np.linalg.inv(T)
        )  # fmt: skip
        points = np.concatenate([points, seen(depth, T, camera, rng)])
        if count in moments and len(points) > 50:
            points = points[np.unique(np.round(points / 0.04).astype(int), axis=0, return_index=True)[1]]
            near = gather(points, evidence, corner, SPACING)
            yield features(near), torch.from_numpy(truth), torch.from_numpy(mask)


def seen(depth: np.ndarray, T: np.ndarray, camera: tuple[float, ...], rng: np.random.Generator) -> np.ndarray:
    """Surface points (n, 3) [m] of a depth image, scattered about as far as fused ones; denser than its pixels."""
    v, u = np.nonzero(depth)
    z = depth[v, u]
    steps = [(0.0, 0.0)]
    right = np.roll(depth, -1, 1)[v, u]
    below = np.roll(depth, -1, 0)[v, u]
    smooth = (
        (np.abs(right - z) < 0.15 * z)
        & (np.abs(below - z) < 0.15 * z)
        & (u < IMAGE[1] - 1)
        & (v < IMAGE[0] - 1)
    )
    out = []
    # Fused surfaces have a point every 4 cm; fill in between pixels where the depth is smooth.
    for a, b in [*steps, (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)]:
        keep = smooth | (a == b == 0)
        d = z + a * (right - z) + b * (below - z)
        p = np.stack([(u + a - camera[2]) / camera[0] * d, (v + b - camera[3]) / camera[1] * d, d], axis=1)[
            keep
        ]
        out.append(p @ T[:3, :3].T + T[:3, 3])
    points = np.concatenate(out)
    return (points + rng.normal(0, 0.004, points.shape)).astype(np.float32)


def truth_of(room: RandomRoom, solids: tuple, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True distances [m] of the window's nodes, and which of them lie in the room or just inside its walls."""
    axes = [SPACING * (c + np.arange(n)) for c, n in zip(corner, WINDOW, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    c, s = np.cos(room.yaw), np.sin(room.yaw)
    local = np.stack([c * nodes[:, 0] + s * nodes[:, 1], c * nodes[:, 1] - s * nodes[:, 0]], axis=1)
    mask = (np.abs(local) < np.array(room.size[:2]) / 2 + INTO_WALLS).all(axis=1)
    mask &= (nodes[:, 2] > room.floor - INTO_WALLS) & (nodes[:, 2] < room.floor + room.size[2])
    truth = np.zeros(len(nodes), dtype=np.float32)
    truth[mask] = scene_distance(*solids, nodes[mask])
    return truth.reshape(tuple(WINDOW)), mask.reshape(tuple(WINDOW))


def camera_way(rng: np.random.Generator, room: RandomRoom, solids: tuple) -> list[np.ndarray]:
    """Poses of a camera that drives through the room, goes round a piece, or looks down on one."""

    def free(p: np.ndarray, clearance: float) -> bool:
        c, s = np.cos(room.yaw), np.sin(room.yaw)
        inside = abs(c * p[0] + s * p[1]) < room.size[0] / 2 and abs(c * p[1] - s * p[0]) < room.size[1] / 2
        return inside and scene_distance(*solids, p[None])[0] > clearance

    style = rng.choice(["drive", "round", "look"], p=[0.5, 0.25, 0.25]) if len(room.pieces) else "drive"
    poses: list[np.ndarray] = []
    if style == "drive":
        height, pitch = rng.uniform(0.8, 1.6), rng.uniform(0.0, 0.6)
        for _ in range(50):
            p = np.array([*rng.uniform(-0.5, 0.5, 2) * max(room.size[:2]), height])
            if free(p, 0.3):
                break
        else:
            return []
        heading, sway = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.8)
        for n in range(int(rng.integers(8, 60))):
            ahead = p + 0.2 * np.array([np.cos(heading), np.sin(heading), 0])
            if free(ahead, 0.3):
                p = ahead
                heading += rng.normal(0, 0.12)
            else:
                heading += 0.45
            yaw = heading + sway * np.sin(0.5 * n)
            poses.append(looking(p, p + np.array([np.cos(yaw), np.sin(yaw), -np.tan(pitch)])))
        return poses
    target = room.pieces[rng.integers(len(room.pieces))] + rng.normal(0, 0.1, 3)
    angle = rng.uniform(0, 2 * np.pi)
    if style == "round":
        radius, rise, sweep = rng.uniform(0.5, 1.6), rng.uniform(0.1, 0.9), rng.uniform(0.4, 6.3)
        for n in range(24):
            a = angle + sweep * n / 24
            p = target + np.array([radius * np.cos(a), radius * np.sin(a), rise])
            if free(p, 0.1):
                poses.append(looking(p, target))
        return poses
    stand = target + np.array([np.cos(angle), np.sin(angle), 0]) * rng.uniform(0.6, 1.3)
    stand[2] = rng.uniform(1.0, 1.6)
    for _ in range(24):
        p = stand + rng.normal(0, 0.12, 3)
        if free(p, 0.1):
            poses.append(looking(p, target + rng.normal(0, 0.45, 3) * np.array([1, 1, 0.4])))
    return poses


def looking(eye: np.ndarray, at: np.ndarray) -> np.ndarray:
    """T_world_camera (4, 4) of a level camera at `eye` that looks at `at` [m]."""
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x) + 1e-9
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = eye
    return T


Command = Annotated[Data, tyro.conf.subcommand("data")] | Annotated[Train, tyro.conf.subcommand("train")]

if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(Command).run()  # type: ignore[arg-type]
