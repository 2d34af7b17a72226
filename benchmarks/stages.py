"""Where time goes: of a training step, as the paper lists it, and of a frame in the default map."""

from __future__ import annotations

import cProfile
import pstats
import time

from isdf import IsdfMapper, Mapper
from isdf.datasets import DepthSequence

# Functions by whose running time, all they call included, a stage is measured: (file's end, name).
STAGES = {
    "sampling": (("isdf/sampling.py", "sample_rays"), ("isdf/keyframes.py", "draw")),
    "bounds": (("isdf/bounds.py", "supervise"),),
    "forward": (("isdf/network.py", "distance_and_gradient"), ("isdf/losses.py", "total_loss")),
    "backward": (("torch/_tensor.py", "backward"), ("torch/optim/optimizer.py", "wrapper")),
}

# The same of the default map, with what a snapshot costs.
MAP_STAGES = {
    "compare": (("mapping/mapper.py", "_appeared"),),
    "fuse": (("mapping/mapper.py", "_fuse"),),
    "calibrate": (("mapping/distortion.py", "learn"), ("mapping/distortion.py", "correct")),
    "guess": (("mapping/mapper.py", "_guess"),),
    "refresh": (("mapping/refresh.py", "refresh"),),
    "snapshot": (("mapping/mapper.py", "field"),),
}


def map_stages(sequence: DepthSequence, stride: int = 3) -> dict[str, float]:
    """CPU time of each stage of the default map, each frame followed by a snapshot [ms a frame].

    Args:
        sequence: every `stride`-th frame of it is integrated, as a mapper does that gets behind.
        stride: of the frames.
    """
    mapper, profile = Mapper(), cProfile.Profile(time.process_time)
    frames = [sequence[n] for n in range(0, len(sequence), stride)]

    def run() -> None:
        for frame in frames:
            mapper.integrate(frame)
            mapper.field()

    profile.runcall(run)
    stats = pstats.Stats(profile)
    times = {
        stage: sum(_cumulative(stats, *place) for place in places) for stage, places in MAP_STAGES.items()
    }
    whole = _cumulative(stats, "mapping/mapper.py", "integrate") + times["snapshot"]
    times |= {"other": whole - sum(times.values()), "frame": whole}
    return {stage: 1e3 * seconds / len(frames) for stage, seconds in times.items()}


def stage_times(mapper: IsdfMapper, steps: int) -> dict[str, float]:
    """CPU time of each stage of a training step [ms], with what is left as "other" and their sum as "step".

    Args:
        mapper: has seen a frame; it is trained further.
        steps: to take the mean of.

    Raises:
        LookupError: a stage's function was not called: it has another name now, and STAGES must follow.
    """
    profile = cProfile.Profile(time.process_time)
    profile.runcall(lambda: [mapper.step() for _ in range(steps)])
    stats = pstats.Stats(profile)
    times = {stage: sum(_cumulative(stats, *place) for place in places) for stage, places in STAGES.items()}
    step = _cumulative(stats, "isdf/isdf_mapper.py", "step")
    times |= {"other": step - sum(times.values()), "step": step}
    return {stage: 1e3 * seconds / steps for stage, seconds in times.items()}


def _cumulative(stats: pstats.Stats, file: str, name: str) -> float:
    found = [
        entry[3]
        for place, entry in stats.stats.items()  # type: ignore[attr-defined]
        if place[0].replace("\\", "/").endswith(file) and place[2] == name
    ]
    if not found:
        raise LookupError(
            f"no call of {name} in {file} during the steps; correct the table of stages in benchmarks.stages"
        )
    return float(sum(found))
