"""The `isdf` command, and its longest part: mapping a recorded sequence."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import io
import json
import logging
import os
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import numpy as np
import torch
import tyro
from tqdm import tqdm

from .atomic import sweep
from .checkpointing import Checkpointer, Stopped, take_up
from .commands import MAP_FILE, Export, Info, Outcome, Query
from .datasets import DepthSequence, open_sequence
from .errors import CheckpointError, ConfigError, IsdfError
from .isdf_mapper import IsdfConfig
from .mapping import MapperConfig
from .methods import Config, OnlineMapper, VoxelConfig
from .results import write_results
from .runner import Begun, RunReport, Timer, Watch, run_at_rate, run_at_steps, run_every_frame
from .viewer.command import View
from .voxel import ExactConfig, FiestaConfig, KinectFusionConfig, VoxbloxConfig

if TYPE_CHECKING:
    from .viewer.watching import Watching

logger = logging.getLogger(__name__)

VOXEL_METHODS: dict[str, type[VoxelConfig]] = {
    "exact": ExactConfig,
    "voxblox": VoxbloxConfig,
    "fiesta": FiestaConfig,
    "kinectfusion": KinectFusionConfig,
}

ANEW = ("viewer", "viewer_port", "record", "json")
"""Options that are no part of a run: given anew when it is resumed."""


@dataclass(frozen=True)
class Map:
    """Map a recorded sequence; leave map, mesh, slices and report in a folder."""

    sequence_dir: tyro.conf.Positional[Path | None] = None
    """Recorded folder, ReplicaCAD, Replica, ScanNet, 7-Scenes or TUM RGB-D sequence, or a ROS bag."""
    out: Path | None = None
    """Folder for the results; made if missing."""
    resume: Path | None = None
    """Go on with a run that was stopped or killed, from the checkpoint in its --out folder. All other options but
    --json are those it was started with."""
    checkpoint_every: float = 10.0
    """Seconds of wall time between two checkpoints of the map; killed at any moment, a run has lost no more than
    that. Saving does not count against the clock."""
    steps_per_frame: int | None = None
    """Clock 1 of 3: every frame is mapped, and trained on for so many optimisation steps."""
    steps_per_second: float | None = None
    """Clock 2 of 3, live as on a machine that makes so many optimisation steps a second, whatever this one makes
    (the paper's made about 30); frames that arrive while it is busy are dropped."""
    cpu_per_second: float | None = None
    """Clock 3 of 3, live on this machine: at most so many CPU seconds (of all threads) for each second of
    sequence, and frames that arrive while it is busy are dropped. 1.0 when no clock is given."""
    method: Literal["default", "isdf", "exact", "voxblox", "fiesta", "kinectfusion"] = "default"
    """default: exact where the camera looked, guessed by a network elsewhere. isdf: the paper's neural field.
    exact: distances to sub-voxel surface points of a TSDF. voxblox, fiesta, kinectfusion: the rivals that the paper
    names. All but isdf make no steps and take no more time than fusion."""
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
    viewer: bool = False
    """Show the map growing in the browser, at an address that is printed; with play, pause and step."""
    viewer_port: int = 8080
    """Of the viewer's page; the next free one where it is taken."""
    record: Path | None = None
    """Folder for a recording that `isdf view FOLDER` plays."""
    json: bool = False
    """Print the outcome as one line of JSON."""

    def run(self) -> Outcome:
        """Map, then write the results."""
        if self.resume is None:
            return self._map(Begun(RunReport()))
        anew = {name: getattr(self, name) for name in ANEW}
        if self != Map(resume=self.resume, **anew):
            raise ConfigError(
                "--resume goes on as the run was started; leave all other options but --json, --viewer, "
                "--viewer-port and --record out"
            )
        begun, options = take_up(self.resume / MAP_FILE)
        return dataclasses.replace(_restored(options, self.resume), **anew)._map(begun)

    def _map(self, begun: Begun) -> Outcome:
        if self.sequence_dir is None or self.out is None:
            raise ConfigError("give a sequence and --out FOLDER, or --resume FOLDER")
        self._check()
        torch.set_num_threads(max(1, self.threads))
        sequence, path = open_sequence(self.sequence_dir, self.fps), self.out / MAP_FILE
        sweep(path)
        with (
            self._watching(sequence) as watching,
            tqdm(total=len(sequence), unit="frame", desc="mapping", disable=None) as bar,
        ):

            def progress(mapper: OnlineMapper, arrived: int) -> None:
                bar.update(arrived - bar.n)
                if watching is not None:
                    watching.update(mapper, arrived, lambda: watch.stopping)

            with Checkpointer(path, self.checkpoint_every, begun.report, self._options(), progress) as watch:
                try:
                    mapper, report = self._run(sequence, self._config(), watch, begun, watching)
                except Stopped as stopped:
                    if stopped.saved:
                        logger.warning("go on with: isdf map --resume %s", self.out)
                    raise
            watch.save(mapper, finished=True)
            return write_results(mapper, report, sequence, self.out, self)

    def _watching(self, sequence: DepthSequence) -> contextlib.AbstractContextManager[Watching | None]:
        """What shows and records the run, if that is asked for."""
        if not self.viewer and self.record is None:
            return contextlib.nullcontext()
        from .viewer.watching import Watching

        watching = Watching(sequence, self.viewer_port if self.viewer else None, self.record, self.up)
        if watching.viewer is not None:
            print(f"viewer: {watching.viewer.url}", file=sys.stderr, flush=True)
        return watching

    def _check(self) -> None:
        """Refuse what would fail only after an hour of mapping."""
        clocks = (self.steps_per_frame, self.steps_per_second, self.cpu_per_second)
        if sum(clock is not None for clock in clocks) > 1:
            raise ConfigError("give one of --steps-per-frame, --steps-per-second and --cpu-per-second")
        if not self.mesh_spacing > 0 or not self.checkpoint_every > 0:
            raise ConfigError(
                "--mesh-spacing and --checkpoint-every must be positive, got "
                f"{self.mesh_spacing} and {self.checkpoint_every}"
            )
        if self.up is not None and not 0 < np.linalg.norm(self.up) < np.inf:
            raise ConfigError(f"--up must be a direction, got {self.up}")

    def _options(self) -> dict[str, Any]:
        """What it takes to start this run again, but for the folder it is in."""
        assert self.sequence_dir is not None
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        values["sequence_dir"] = str(self.sequence_dir.resolve())
        given = {f.name for f in dataclasses.fields(self) if values[f.name] != f.default}
        return {name: values[name] for name in sorted(given - {"out", "resume", *ANEW})}

    def _run(
        self,
        sequence: DepthSequence,
        config: Config,
        watch: Watch,
        begun: Begun,
        watching: Watching | None,
    ) -> tuple[OnlineMapper, RunReport]:
        timer: Timer = time.process_time
        if watching is not None:
            sequence, timer = watching.sequence, watching.timer
        if self.steps_per_frame is not None:
            return run_every_frame(sequence, config, self.steps_per_frame, watch, begun, timer)
        if self.steps_per_second is not None:
            if not isinstance(config, IsdfConfig):
                raise ConfigError(
                    f"--steps-per-second belongs to --method isdf; {self.method} makes no steps"
                )
            return run_at_steps(sequence, config, self.steps_per_second, watch, begun, timer)
        rate = 1.0 if self.cpu_per_second is None else self.cpu_per_second
        return run_at_rate(sequence, config, rate, watch, begun, timer)

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


def _restored(options: dict[str, Any], out: Path) -> Map:
    """The command that a run was started with, checked as if it were typed again."""
    words = ["--out", str(out)]
    for name, value in options.items():
        values = value if isinstance(value, list) else [value]
        option = [] if name == "sequence_dir" else [f"--{name.replace('_', '-')}"]
        words += [*option, *(str(v) for v in values)]
    try:
        return tyro.cli(Map, args=words, console_outputs=False)
    except SystemExit:
        raise CheckpointError(
            f"{out / MAP_FILE}: its run has impossible options: {' '.join(words)}"
        ) from None


COMMANDS: dict[str, type] = {"map": Map, "query": Query, "export": Export, "info": Info, "view": View}

Command = (
    Annotated[Map, tyro.conf.subcommand("map")]
    | Annotated[Query, tyro.conf.subcommand("query")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[View, tyro.conf.subcommand("view")]
)

# tyro joins lines that are not indented.
DESCRIPTION = """Signed distance fields from posed depth images.
  isdf map RECORDING --out FOLDER                      a map of a recording
  isdf map --resume FOLDER                             go on after a stop
  isdf query FOLDER --points P.npy --out ANSWERS.npz   distances and gradients
  isdf export FOLDER --format ply --out MESH.ply       for other programs
  isdf info FOLDER                                     what a map file says
  isdf view RECORDING                                  a recording, or a map
  isdf COMMAND --help                                  the options of a command
  --json: outcome or error as one line of JSON on stdout or stderr
  exit codes:
    0     done
    1     a file could not be read or written, or a bug
    2     bad input, an unknown command or an unknown option
    130   stopped by Ctrl-C, 143 by SIGTERM; isdf map leaves a checkpoint then"""


def main() -> None:
    """Entry point of the `isdf` command; what goes wrong is said in one line, see `DESCRIPTION` for exit codes."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    words = sys.argv[1:]
    as_json = "--json" in words
    try:
        outcome = _parsed(words, as_json).run()
        print(json.dumps(outcome.data) if as_json else outcome.text, flush=True)
    except IsdfError as error:
        _fail(2, type(error).__name__, str(error), as_json)
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        _fail(1, type(error).__name__, str(error), as_json)
    except Stopped as stopped:
        _fail(128 + stopped.number, "Stopped", str(stopped), as_json)
    except KeyboardInterrupt:
        _fail(130, "Stopped", "stopped by SIGINT", as_json)


def _parsed(words: list[str], as_json: bool) -> Map | Query | Export | Info | View:
    """The command that the words ask for.

    Raises:
        ConfigError: there is no such command; or, for machines, what tyro has to say about an option.
        SystemExit: --help, or tyro has told a person which option is wrong.
    """
    if words and not words[0].startswith("-") and words[0] not in COMMANDS:
        close = difflib.get_close_matches(words[0], COMMANDS, n=1, cutoff=0.4)
        guess = f"did you mean {close[0]}? " if close else ""
        raise ConfigError(f"there is no command {words[0]!r}; {guess}The commands are {', '.join(COMMANDS)}")
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said) if as_json else contextlib.nullcontext():
            return tyro.cli(Command, prog="isdf", description=DESCRIPTION)  # type: ignore[arg-type]
    except SystemExit as end:
        if as_json and end.code:
            raise ConfigError(" ".join(re.sub("[╭╮╰╯─│]", " ", said.getvalue()).split())) from None
        raise


def _fail(code: int, kind: str, message: str, as_json: bool) -> NoReturn:
    line = json.dumps({"error": kind, "message": message}) if as_json else f"isdf: {message}"
    print(line, file=sys.stderr)
    sys.exit(code)
