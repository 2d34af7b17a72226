"""Where a training step's time goes: sampling, bounds, forward and backward pass, as the paper lists it."""

from __future__ import annotations

import cProfile
import pstats
import time

from isdf import IsdfMapper

# Functions by whose running time, all they call included, a stage is measured: (file's end, name).
STAGES = {
    "sampling": (("isdf/sampling.py", "sample_rays"), ("isdf/keyframes.py", "draw")),
    "bounds": (("isdf/bounds.py", "supervise"),),
    "forward": (("isdf/network.py", "distance_and_gradient"), ("isdf/losses.py", "total_loss")),
    "backward": (("torch/_tensor.py", "backward"), ("torch/optim/optimizer.py", "wrapper")),
}


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
        raise LookupError(f"no call of {name} in {file} during the steps; correct benchmarks.stages.STAGES")
    return float(sum(found))
