"""Feeding a recorded sequence to a mapper as a live camera would, by one of three clocks."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from .datasets import DepthSequence
from .errors import ConfigError, DatasetError, FrameError
from .isdf_mapper import IsdfConfig, IsdfMapper
from .methods import Config, OnlineMapper, new_mapper

logger = logging.getLogger(__name__)

Watch = Callable[[OnlineMapper, int], None]
"""Called with the mapper and the number of frames that have arrived; what it does costs the mapper no time."""
Timer = Callable[[], float]
"""CPU time used so far [s]: `time.process_time`, less that of threads which do not belong to mapping."""


@dataclass
class RunReport:
    """What happened while a sequence was mapped. Times in seconds, of this process's CPU clock over all threads.

    It is kept up to date while a run goes on. With it and the mapper a run can be resumed: every clock starts from
    `frames_arrived`, `cpu_seconds` and `waited_seconds`.
    """

    frames: int = 0
    frames_arrived: int = 0
    frames_used: int = 0
    frames_dropped: int = 0
    frames_refused: dict[int, str] = field(default_factory=dict)
    keyframes: int = 0
    steps: int = 0
    sequence_seconds: float = 0.0
    cpu_seconds: float = 0.0
    wall_seconds: float = 0.0
    waited_seconds: float = 0.0


@dataclass(frozen=True)
class Begun:
    """A run so far: its report, which the runner keeps up to date, and its mapper, None where there is none yet."""

    report: RunReport
    mapper: OnlineMapper | None = None


class _Stopwatch:
    """CPU and wall seconds spent on mapping, without what the watcher uses; kept up to date in the report."""

    def __init__(self, watch: Watch, report: RunReport, timer: Timer) -> None:
        self._watch, self._report, self._timer = watch, report, timer
        self._cpu = timer() - report.cpu_seconds
        self._wall = time.perf_counter() - report.wall_seconds

    @property
    def cpu(self) -> float:
        return self._timer() - self._cpu

    @property
    def wall(self) -> float:
        return time.perf_counter() - self._wall

    def watch(self, mapper: OnlineMapper, arrived: int) -> None:
        cpu, wall = self._timer(), time.perf_counter()
        report = self._report
        report.cpu_seconds, report.wall_seconds = self.cpu, self.wall
        report.frames_arrived, report.steps = arrived, mapper.steps
        self._watch(mapper, arrived)
        self._cpu += self._timer() - cpu
        self._wall += time.perf_counter() - wall


def run_every_frame(
    sequence: DepthSequence,
    config: Config,
    steps_per_frame: int,
    watch: Watch,
    begun: Begun | None = None,
    timer: Timer = time.process_time,
) -> tuple[OnlineMapper, RunReport]:
    """Every frame is integrated and given exactly `steps_per_frame` steps, however long they take.

    Only the paper's method makes steps; the others just integrate.
    """
    if steps_per_frame < 1:
        raise ConfigError(f"steps_per_frame must be at least 1, got {steps_per_frame}")
    if isinstance(config, IsdfConfig):
        config = replace(
            config, first_frame_steps=steps_per_frame, steps_per_frame=steps_per_frame, keyframe_steps=0
        )
    mapper, report = _take_up(begun, config)
    spent = _Stopwatch(watch, report, timer)
    for index in range(report.frames_arrived, len(sequence)):
        _integrate(mapper, sequence, index, report)
        spent.watch(mapper, index + 1)
    return mapper, _finish(report, mapper, sequence, spent)


def run_at_steps(
    sequence: DepthSequence,
    config: IsdfConfig,
    steps_per_second: float,
    watch: Watch,
    begun: Begun | None = None,
    timer: Timer = time.process_time,
) -> tuple[OnlineMapper, RunReport]:
    """As on a machine that makes so many steps a second, whatever this one makes (the paper's GPU made about 30).

    The sequence's clock advances with the steps: the mapper gets the newest frame, trains on it as long as the
    configuration says (200 steps on the first frame, 10 on others, 60 more on keyframes in the paper), and frames
    that arrived meanwhile are dropped.
    """
    if not steps_per_second > 0:
        raise ConfigError(f"steps_per_second must be positive, got {steps_per_second}")
    if config.steps_per_frame < 1:
        raise ConfigError("the clock stands still with steps_per_frame = 0; give at least 1")
    mapper, report = _take_up(begun, config)
    spent = _Stopwatch(watch, report, timer)
    index = report.frames_arrived
    while index < len(sequence):
        refused = not _integrate(mapper, sequence, index, report)
        arrived = int(mapper.steps / steps_per_second * sequence.fps)
        index = index + 1 if refused else max(index + 1, arrived)
        spent.watch(mapper, min(index, len(sequence)))
    report.frames_dropped = len(sequence) - report.frames_used - len(report.frames_refused)
    return mapper, _finish(report, mapper, sequence, spent)


def run_at_rate(
    sequence: DepthSequence,
    config: Config,
    cpu_per_second: float,
    watch: Watch,
    begun: Begun | None = None,
    timer: Timer = time.process_time,
) -> tuple[OnlineMapper, RunReport]:
    """Live: at most `cpu_per_second` CPU seconds for each second of sequence.

    The sequence's clock advances with the CPU time used. When the mapper is ready for another frame it gets the
    newest that has arrived; those it missed are dropped. While none has arrived the paper's method trains on; the
    others, which have nothing to train, wait for it: the clock is moved on to then.
    """
    if not cpu_per_second > 0:
        raise ConfigError(f"cpu_per_second must be positive, got {cpu_per_second}")
    live, frame_steps = config, 0
    if isinstance(config, IsdfConfig):
        live = replace(config, first_frame_steps=0, steps_per_frame=0, keyframe_steps=0)
        frame_steps = config.steps_per_frame
    mapper, report = _take_up(begun, live)
    spent = _Stopwatch(watch, report, timer)
    budget = len(sequence) / sequence.fps * cpu_per_second
    patience, last = frame_steps, report.frames_arrived - 1
    while (used := spent.cpu + report.waited_seconds) < budget:
        newest = min(int(used / cpu_per_second * sequence.fps), len(sequence) - 1)
        if newest > last and _integrate(mapper, sequence, newest, report):
            patience = frame_steps
        last = newest
        spent.watch(mapper, newest + 1)
        # Nothing usable yet, or nothing to train: wait for the next frame without burning time.
        if mapper.frames_seen == 0 or not isinstance(mapper, IsdfMapper):
            newest_time = (newest + 1) / sequence.fps * cpu_per_second
            report.waited_seconds += max(0.0, newest_time - (spent.cpu + report.waited_seconds))
            continue
        # The paper's rule: a new frame gets its steps before the next one is looked for.
        for _ in range(max(1, patience)):
            if spent.cpu + report.waited_seconds >= budget:
                break
            mapper.step()
        patience = 1
    report.frames_dropped = len(sequence) - report.frames_used - len(report.frames_refused)
    spent.watch(mapper, len(sequence))
    return mapper, _finish(report, mapper, sequence, spent)


def _take_up(begun: Begun | None, config: Config) -> tuple[OnlineMapper, RunReport]:
    """The mapper and report of a run that has begun, or new ones.

    Raises:
        ConfigError: the mapper was made with another configuration.
    """
    if begun is None or begun.mapper is None:
        return new_mapper(config), RunReport() if begun is None else begun.report
    if begun.mapper.config != config:
        raise ConfigError(f"the run began with {begun.mapper.config}, it cannot go on with {config}")
    return begun.mapper, begun.report


def _integrate(mapper: OnlineMapper, sequence: DepthSequence, index: int, report: RunReport) -> bool:
    """Give one frame to the mapper; an unusable one is recorded and passed over, as a live camera's would be."""
    before = mapper.frames_seen
    try:
        mapper.integrate(sequence[index])
    except (FrameError, DatasetError) as error:
        logger.warning("frame %d passed over: %s", index, error)
        report.frames_refused[index] = str(error)
        return False
    if mapper.frames_seen == before:  # the mapper has said why in the log
        report.frames_refused[index] = "it contradicts the map or repeats the last image"
        return False
    report.frames_used += 1
    return True


def _finish(report: RunReport, mapper: OnlineMapper, sequence: DepthSequence, spent: _Stopwatch) -> RunReport:
    if mapper.frames_seen == 0:
        raise DatasetError(
            f"{sequence.folder}: none of the {len(sequence)} frames could be used; the first was refused because "
            f"{next(iter(report.frames_refused.values()), 'it never arrived')}"
        )
    if isinstance(mapper, IsdfMapper):
        report.keyframes = len(mapper.keyframes)
    else:
        mapper.refresh()
    report.frames, report.steps = len(sequence), mapper.steps
    report.sequence_seconds = len(sequence) / sequence.fps
    report.cpu_seconds, report.wall_seconds = spent.cpu, spent.wall
    return report
