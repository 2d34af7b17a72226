"""The `isdf` command: map a recorded sequence, query a map."""

from __future__ import annotations

import dataclasses
import json
import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from tqdm import tqdm

from .datasets import DepthSequence, open_sequence
from .errors import ConfigError, IsdfError
from .field import query
from .isdf_mapper import IsdfConfig, IsdfMapper
from .mapping import MapperConfig
from .methods import Config, OnlineMapper, VoxelConfig, load_map
from .runner import RunReport, Watch, run_at_rate, run_at_steps, run_every_frame
from .voxel import ExactConfig, FiestaConfig, KinectFusionConfig, VoxbloxConfig

MAP_FILE = "map.safetensors"
VOXEL_METHODS: dict[str, type[VoxelConfig]] = {
    "exact": ExactConfig,
    "voxblox": VoxbloxConfig,
    "fiesta": FiestaConfig,
    "kinectfusion": KinectFusionConfig,
}


@dataclass(frozen=True)
class Map:
    """Map a recorded sequence: leaves the map, mesh.ply, slice pictures and report.json in a folder.

    Give one of three clocks. --steps-per-frame K trains K steps on every frame. --cpu-per-second C is live: at most
    C CPU seconds (all threads) for each second of sequence; frames that arrive while it is busy are dropped.
    --steps-per-second K is live on a machine that makes K steps a second, whatever this one makes.
    """

    sequence_dir: tyro.conf.Positional[Path]
    """Recorded folder, ReplicaCAD, Replica, ScanNet, 7-Scenes or TUM RGB-D sequence, or a ROS bag."""
    out: Path
    """Folder for the results; made if missing."""
    steps_per_frame: int | None = None
    """Optimisation steps on every frame."""
    steps_per_second: float | None = None
    """Optimisation steps for each second of sequence; the paper's machine made about 30."""
    cpu_per_second: float | None = None
    """CPU seconds allowed for each second of sequence; 1.0 when neither clock is given."""
    method: Literal["default", "isdf", "exact", "voxblox", "fiesta", "kinectfusion"] = "default"
    """default: exact where the camera looked, guessed by a network elsewhere. isdf: the paper's neural field. exact:
    distances to sub-voxel surface points of a TSDF. voxblox, fiesta, kinectfusion: the rivals that the paper names.
    All but isdf need no steps and no more time than fusion takes."""
    voxel: float | None = None
    """Edge of a voxel of the voxel methods [m]; by default 0.04 (exact), 0.055 (voxblox, fiesta) and 0.07
    (kinectfusion)."""
    preset: Literal["cpu", "paper", "released"] = "cpu"
    """cpu: small network, few rays. paper: the text's sizes. released: those behind the published results."""
    bound: Literal["ray", "normal", "batch"] = "batch"
    """How the distance of a sample is bounded."""
    fps: float | None = None
    """Frames a second; by default what the sequence says, else 30."""
    mesh_spacing: float = 0.04
    """Cell size of the mesh [m]."""
    up: tuple[float, float, float] | None = None
    """Up direction of the world for slices; by default judged from the camera poses."""
    slice_heights: tuple[float, ...] = ()
    """Heights of the slices along up [m]; by default three that divide the observed range."""
    seed: int = 0
    """Seed of all random draws."""
    threads: int = 1
    """Threads of the matrix library; more than one shortens the wall time but costs CPU time."""

    def run(self) -> None:
        """Map, then write the results."""
        clocks = (self.steps_per_frame, self.steps_per_second, self.cpu_per_second)
        if sum(clock is not None for clock in clocks) > 1:
            raise ConfigError("give one of --steps-per-frame, --steps-per-second and --cpu-per-second")
        torch.set_num_threads(max(1, self.threads))
        sequence = open_sequence(self.sequence_dir, self.fps)
        with tqdm(total=len(sequence), unit="frame", desc="mapping", disable=None) as bar:

            def progress(_: OnlineMapper, arrived: int) -> None:
                bar.update(arrived - bar.n)

            mapper, report = self._run(sequence, self._config(), progress)
        self._write(mapper, report, sequence)

    def _run(self, sequence: DepthSequence, config: Config, watch: Watch) -> tuple[OnlineMapper, RunReport]:
        if self.steps_per_frame is not None:
            return run_every_frame(sequence, config, self.steps_per_frame, watch)
        if self.steps_per_second is not None:
            if not isinstance(config, IsdfConfig):
                raise ConfigError(
                    f"--steps-per-second belongs to --method isdf; {self.method} makes no steps"
                )
            return run_at_steps(sequence, config, self.steps_per_second, watch)
        rate = 1.0 if self.cpu_per_second is None else self.cpu_per_second
        return run_at_rate(sequence, config, rate, watch)

    def _config(self) -> Config:
        if self.method != "isdf":
            if self.preset != "cpu" or self.bound != "batch":
                raise ConfigError(
                    f"--preset and --bound belong to --method isdf; leave them out for {self.method}"
                )
            config: VoxelConfig | MapperConfig = VOXEL_METHODS.get(self.method, MapperConfig)()
            if self.voxel is not None and self.method == "default":
                raise ConfigError(f"--voxel belongs to the voxel methods: {', '.join(VOXEL_METHODS)}")
            return config if self.voxel is None else dataclasses.replace(config, voxel=self.voxel)
        if self.voxel is not None:
            raise ConfigError(
                f"--voxel belongs to the voxel methods: add --method {' or '.join(VOXEL_METHODS)}"
            )
        presets = {"cpu": IsdfConfig(), "paper": IsdfConfig.paper(), "released": IsdfConfig.released()}
        return dataclasses.replace(presets[self.preset], seed=self.seed, bound=self.bound)

    def _write(self, mapper: OnlineMapper, report: RunReport, sequence: DepthSequence) -> None:
        from .meshing import zero_level_mesh
        from .slices import estimate_up, save_slices, slice_heights

        self.out.mkdir(parents=True, exist_ok=True)
        mapper.save(self.out / MAP_FILE)
        field = mapper.field()
        poses = sequence.poses[np.isfinite(sequence.poses).all(axis=(1, 2))]
        up = estimate_up(poses) if self.up is None else np.array(self.up) / np.linalg.norm(self.up)
        mesh = zero_level_mesh(field, self.mesh_spacing, up=up)
        mesh.export(self.out / "mesh.ply")
        heights = list(self.slice_heights) or slice_heights(field, up)
        frames = mapper.keyframes.frames if isinstance(mapper, IsdfMapper) else []
        keyframes = np.array([f.T_world_camera[:3, 3].numpy() for f in frames]).reshape(-1, 3)
        save_slices(self.out / "slices.png", field, heights, up, poses, keyframes)
        summary = dataclasses.asdict(report) | {
            "sequence": self.sequence_dir.name,
            "clock": {
                "steps_per_frame": self.steps_per_frame,
                "steps_per_second": self.steps_per_second,
                "cpu_per_second": self.cpu_per_second,
            },
            "method": self.method,
            "preset": self.preset,
            "config": dataclasses.asdict(mapper.config),
            "bounds": mapper.bounds.tolist(),
            "up": up.tolist(),
            "slice_heights": heights,
            "mesh_vertices": len(mesh.vertices),
            "mesh_faces": len(mesh.faces),
        }
        (self.out / "report.json").write_text(json.dumps(summary, indent=1) + "\n")
        print(
            f"{report.frames_used} of {report.frames} frames, {report.keyframes} keyframes, {report.steps} steps in "
            f"{report.cpu_seconds:.1f} CPU s; {self.out}: {MAP_FILE}, mesh.ply ({len(mesh.faces)} faces), slices.png, "
            "report.json"
        )


@dataclass(frozen=True)
class Query:
    """Distances and gradients of a saved map at any world points."""

    run_dir: tyro.conf.Positional[Path]
    """Folder that `isdf map` wrote, or a map file."""
    points: Path
    """A .npy file with an (N, 3) array of world points [m]."""
    out: Path
    """The .npz file to write: distance (N,) [m], gradient (N, 3), and confidence (N,) where the field has one."""

    def run(self) -> None:
        """Load, query, write."""
        path = self.run_dir / MAP_FILE if self.run_dir.is_dir() else self.run_dir
        field = load_map(path).field()
        try:
            points = np.load(self.points, allow_pickle=False)
        except (OSError, ValueError) as error:
            raise IsdfError(f"{self.points}: not a readable .npy array ({error})") from error
        answers = query(field, points)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        np.savez(self.out, **answers)  # type: ignore[arg-type]
        print(f"{len(points)} points: {', '.join(answers)} in {self.out}")


Command = Annotated[Map, tyro.conf.subcommand("map")] | Annotated[Query, tyro.conf.subcommand("query")]


def main() -> None:
    """Entry point of the `isdf` command; exit code 2 on bad input, with one line that says what was wrong."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    command = tyro.cli(Command, prog="isdf", description="Neural signed distance fields from depth images.")  # type: ignore[arg-type]
    try:
        command.run()
    except IsdfError as error:
        print(f"isdf: {error}", file=sys.stderr)
        sys.exit(2)
