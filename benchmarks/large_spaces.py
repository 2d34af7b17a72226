"""Memory and time a frame of the default map as it grows from a room to a house and to a long corridor of rooms.

    ISDF_DATA_DIR=... python -m benchmarks.large_spaces --out runs/large_spaces --publish docs/results.md

A camera looks around once at every spot of each place, one spot after the other, and a snapshot of the field is taken
with every frame and kept until the next, as a planner does. The house (19 x 11 m) is read from
`aws_small_house/small_house_visual_world.ply` in ISDF_DATA_DIR and left out where that is not set. Left behind:
`large_spaces.json` with a row a spot, and `large_spaces.png`; with --publish the table and the picture also take their
places in a Markdown page.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.publishing import publish
from benchmarks.tables import markdown
from isdf import DepthFrame, Mapper, PinholeCamera
from isdf.evaluation.figures import save_small
from robots.simulation.poses import looking
from robots.simulation.ray_casting import RayCaster

HOUSE = Path("aws_small_house") / "small_house_visual_world.ply"
CAMERA = PinholeCamera.from_fov(160, 120, np.radians(70))
FPS, RANGE = 10.0, 5.0
# Views of a look around, and how high the camera stands and how far down it looks [m, rad].
VIEWS, HEIGHT, PITCH = 8, 1.4, 0.35
# Nothing may be this near to a spot [m].
CLEARANCE = 0.35


@dataclass(frozen=True)
class LargeSpaces:
    """Map places of different sizes."""

    out: Path = Path("runs/large_spaces")
    """Folder for the JSON and the plot."""
    spots: int = 40
    """Most spots in the house; it and the corridor have about as many."""
    length: float = 60.0
    """Of the corridor [m]."""
    seed: int = 0
    """Of the corridor's furniture and the house's spots."""
    publish: Path | None = None
    """A Markdown page with places for the table and the picture."""


@dataclass(frozen=True)
class Row:
    """After one look around.

    Args:
        place: room, house or corridor.
        volume: that was looked through so far [m^3].
        state: memory of all that mapping goes on from [MB].
        query: memory of the field that answers [MB].
        frame: CPU time of a frame and a snapshot, mean of this look around [ms].
        snapshot: CPU time of the snapshot alone [ms].
    """

    place: str
    volume: float
    state: float
    query: float
    frame: float
    snapshot: float


def main(options: LargeSpaces) -> None:
    """Map all places; print a line each."""
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(level=logging.WARNING)
    rng = np.random.default_rng(options.seed)
    places = {"room": corridor(rng, 6.0), "corridor": corridor(rng, options.length)}
    folder = os.environ.get("ISDF_DATA_DIR")
    if folder:
        mesh = trimesh.load(Path(folder) / HOUSE)
        places["house"] = (mesh, house_spots(mesh, options.spots, rng))
    else:
        print("ISDF_DATA_DIR is not set: the house is left out")
    rows: list[Row] = []
    for name in sorted(places, key=["room", "house", "corridor"].index):
        mesh, spots = places[name]
        rows += mapped(name, RayCaster(mesh), spots)
        print(f"{name}: mapped", flush=True)
        (options.out / "large_spaces.json").write_text(json.dumps([asdict(row) for row in rows], indent=1))
        plot(options.out / "large_spaces.png", rows)
    text = table(rows)
    print(text)
    if options.publish:
        publish(options.publish, {"large": text}, [options.out / "large_spaces.png"])


def table(rows: list[Row]) -> str:
    """A line a place."""
    head = [
        "place", "looked through [m^3]", "state [MB]", "of that to query [MB]", "a frame, first half [ms]",
        "second half [ms]", "of that the snapshot [ms]",
    ]  # fmt: skip
    lines = []
    for place in dict.fromkeys(row.place for row in rows):
        here = [row for row in rows if row.place == place]
        halves = here[: len(here) // 2], here[len(here) // 2 :]
        frames = [f"{np.mean([row.frame for row in half]):.0f}" for half in halves]
        end, snapshot = here[-1], np.mean([row.snapshot for row in halves[1]])
        lines.append(
            [place, f"{end.volume:.0f}", f"{end.state:.0f}", f"{end.query:.1f}", *frames, f"{snapshot:.2f}"]
        )
    return markdown(head, lines)


def mapped(name: str, rays: RayCaster, spots: Float[np.ndarray, "n 3"]) -> list[Row]:
    """Look around at every spot."""
    mapper, rows, count, held = Mapper(), [], 0, None
    for spot in spots:
        spent, snapshot = 0.0, 0.0
        for n in range(VIEWS):
            frame = view(rays, spot, 2 * np.pi * n / VIEWS, count / FPS)
            count += 1
            if frame is None:
                continue
            begin = time.process_time()
            mapper.integrate(frame)
            middle = time.process_time()
            held = mapper.field()
            spent += time.process_time() - begin
            snapshot += time.process_time() - middle
        lattice = mapper.lattice
        rows_used = lattice.table[lattice.table >= 0]
        free = int((lattice.nodes.arrays["evidence"][rows_used] > 127).sum())
        rows.append(
            Row(
                place=name,
                volume=free * lattice.spacing**3,
                state=mapper.nbytes / 1e6,
                query=held.nbytes / 1e6 if held is not None else 0.0,
                frame=1e3 * spent / VIEWS,
                snapshot=1e3 * snapshot / VIEWS,
            )
        )
    return rows


def view(rays: RayCaster, spot: Float[np.ndarray, "3"], yaw: float, when: float) -> DepthFrame | None:
    """The depth image of a camera that looks along `yaw` and a little down; None where it sees nothing."""
    forward = np.array([np.cos(yaw) * np.cos(PITCH), np.sin(yaw) * np.cos(PITCH), -np.sin(PITCH)])
    T = looking(spot, forward)
    v, u = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    directions = CAMERA.rays(torch.stack([u, v], dim=-1)).double().view(-1, 3).numpy() @ T[:3, :3].T
    depth = rays.cast(spot, directions).reshape(CAMERA.height, CAMERA.width)
    depth = np.where(depth < RANGE, depth, 0).astype(np.float32)
    return DepthFrame(torch.from_numpy(depth), torch.from_numpy(T), CAMERA, when) if depth.any() else None


def corridor(rng: np.random.Generator, length: float) -> tuple[trimesh.Trimesh, Float[np.ndarray, "n 3"]]:
    """A corridor 2 m wide with a furnished room of 6 x 5 m at every 6 m of it, and the spots along it."""
    boxes = [((length / 2, 3.5, -0.05), (length, 7, 0.1)), ((length / 2, 3.5, 2.65), (length, 7, 0.1))]
    boxes += [((length / 2, y, 1.3), (length, 0.1, 2.6)) for y in (0.0, 7.0)]
    spots = []
    for start in np.arange(0, length, 6.0):
        boxes += [((start, 3.5 if start == 0 else 4.5, 1.3), (0.1, 7 if start == 0 else 5, 2.6))]
        # The wall to the corridor leaves a doorway in its middle.
        boxes += [((start + x, 2.0, 1.3), (2.5, 0.1, 2.6)) for x in (1.25, 4.75)]
        for _ in range(4):
            x, y = start + rng.uniform(0.6, 5.4), rng.choice([rng.uniform(2.5, 3.2), rng.uniform(5.8, 6.5)])
            size = rng.uniform((0.3, 0.3, 0.3), (1.0, 0.8, 1.2))
            if abs(x - start - 3) > 0.9 or y > 5:
                boxes.append(((x, y, size[2] / 2), tuple(size)))
        spots += [(start + 1.5, 1.0), (start + 3.0, 1.0), (start + 3.0, 4.5), (start + 4.5, 1.0)]
    boxes.append(((length, 3.5, 1.3), (0.1, 7, 2.6)))
    solids = [
        trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre))
        for centre, size in boxes
    ]
    return trimesh.util.concatenate(solids), np.array([(x, y, HEIGHT) for x, y in spots])


def house_spots(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Random free spots over a floor, each the nearest to the one before that is left."""
    rays, around = RayCaster(mesh), np.linspace(0, 2 * np.pi, 32, endpoint=False)
    fan = np.concatenate(
        [np.stack([np.cos(around), np.sin(around), np.full(32, slope)], axis=1) for slope in (-1.0, 0.0, 0.7)]
    )
    fan /= np.linalg.norm(fan, axis=1, keepdims=True)
    left = []
    while len(left) < count:
        x, y = rng.uniform(mesh.bounds[0, :2] + 0.5, mesh.bounds[1, :2] - 0.5)
        spot = np.array([x, y, HEIGHT])
        if rays.cast(spot, fan).min() > CLEARANCE:
            left.append(spot)
    way = [left.pop(int(np.argmin([p[0] for p in left])))]
    while left:
        way.append(left.pop(int(np.argmin([np.linalg.norm(p - way[-1]) for p in left]))))
    return np.array(way)


def plot(path: Path, rows: list[Row]) -> None:
    """Memory and time against the volume that was looked through."""
    figure = Figure(figsize=(7, 6), layout="constrained")
    memory, times = figure.subplots(2, 1, sharex=True)
    for number, place in enumerate(dict.fromkeys(row.place for row in rows)):
        here = [row for row in rows if row.place == place]
        volume, colour = [row.volume for row in here], f"C{number}"
        memory.plot(volume, [row.state for row in here], color=colour, label=f"{place}: whole state")
        memory.plot(
            volume, [row.query for row in here], color=colour, linestyle="--", label=f"{place}: to query"
        )
        times.plot(volume, [row.frame for row in here], color=colour, marker=".", label=f"{place}: frame")
        times.plot(
            volume, [row.snapshot for row in here], color=colour, linestyle="--", label=f"{place}: snapshot"
        )
    memory.set_ylabel("memory [MB]")
    times.set_ylabel("CPU time a frame [ms]")
    times.set_xlabel("volume looked through [m$^3$]")
    for axes in (memory, times):
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, ncols=2)
    save_small(figure, path, 80)


if __name__ == "__main__":
    main(tyro.cli(LargeSpaces))
