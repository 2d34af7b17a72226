"""Sampled paths for robots and fields that can be compiled: RRT-Connect in milliseconds."""

from __future__ import annotations

import time

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from planning.exact_shape import ExactShape
from planning.initialise import WIDE_RANGE, NoPath, RrtConfig

SAMPLES = 2000  # of the first attempt; each further one has twice as many
MOST_SAMPLES = 100_000
NODES = 20_000
LONGER = 0.04  # [s] after which a path that was found is not bettered by looking for others
MOTION_PER_METRE = 2.0  # edges of the compiled search are longer: the 1-norm overestimates motion
SAMPLES_AT_ONCE, SHORTCUTS_AT_ONCE = 200, 50  # between two looks at the clock
CHECKS = 0.1  # resolution of the last look at a path, relative to that of the search


def search(
    shape: ExactShape,
    start: Float[Tensor, " dof"],
    goals: Float[Tensor, "g dof"],
    config: RrtConfig,
    seed: int,
    deadline: float,
) -> Float[Tensor, "k dof"] | NoPath:
    """The shortest of `config.candidates` free paths from start to the goals in turn, each shortened.

    Starts anew with twice the samples where it finds nothing, and with half the margin every second time.

    Args:
        shape: the robot among the solids.
        start: free.
        goals: of which the free ones are tried.
        config: of the search.
        seed: of the samples.
        deadline: `time.perf_counter()` at which it ends.
    """
    from planning.compiled.search import length
    from planning.compiled.states import first_blocked

    rng = np.random.default_rng(seed)
    ends = np.concatenate([start[None].double().numpy(), goals.double().numpy()])
    world, usable = _with_end_margins(shape, ends, config)
    if not usable[0]:
        return NoPath("start is blocked: in collision or out of limits")
    targets = [ends[i] for i in range(1, len(ends)) if usable[i]]
    if not targets:
        return NoPath("goal is blocked: in collision or out of limits")
    best, found, samples, started = None, 0, SAMPLES, time.perf_counter()
    resolution = config.resolution
    for attempt in range(1000):
        goal = targets[attempt % len(targets)]
        tight = world._replace(
            margin=world.margin * 0.5 ** (attempt // (2 * len(targets)) if best is None else 0)
        )
        reach = MOTION_PER_METRE * config.reach
        path = _connected(tight, ends[0], goal, rng, reach, resolution, samples, deadline)
        path = _shortened(tight, path, rng, resolution, config.shortcut_rounds, deadline)
        if len(path) and first_blocked(tight, path, CHECKS * config.resolution) < 0:
            found += 1
            if best is None or length(path) < length(best):
                best = path
            if found >= config.candidates * len(targets) or len(path) == 2:
                break
        elif len(path):  # an obstacle was between two states of an edge
            resolution *= 0.5
        else:
            samples = min(2 * samples, MOST_SAMPLES)
        now = time.perf_counter()
        if now > deadline or (best is not None and now - started > LONGER):
            break
    if best is None:
        return NoPath(f"no path found in {config.seconds:g} s ({attempt + 1} attempts)")
    return torch.from_numpy(best).to(start)


def _connected(world, start, goal, rng, reach, resolution, samples, deadline):  # type: ignore[no-untyped-def]
    """A free path, straight if that is free; (0, dof) where the samples or the time were not enough."""
    from planning.compiled.search import grow, planted
    from planning.compiled.states import edge_free

    path = np.empty((0, len(start)))
    if time.perf_counter() > deadline:
        return path
    if edge_free(world, start, goal, resolution):
        return np.stack([start, goal])
    trees = planted(start, goal, NODES)
    for _ in range(0, samples, SAMPLES_AT_ONCE):
        path = grow(world, trees, rng, reach, resolution, SAMPLES_AT_ONCE)
        if len(path) or time.perf_counter() > deadline:
            break
    return path


def _shortened(world, path, rng, resolution, rounds, deadline):  # type: ignore[no-untyped-def]
    """The path after random shortcuts, as many as there are rounds or time."""
    from planning.compiled.search import shorten

    for _ in range(0, rounds, SHORTCUTS_AT_ONCE):
        if len(path) < 3 or time.perf_counter() > deadline:
            break
        path = shorten(world, path, rng, resolution, SHORTCUTS_AT_ONCE)
    return path


def _with_end_margins(shape: ExactShape, ends: np.ndarray, config: RrtConfig):  # type: ignore[no-untyped-def]
    """The world with the margins that the ends themselves keep, and which ends are usable."""
    from planning.compiled.states import free

    depth, _, gap, _ = shape.measure(torch.from_numpy(ends), np.inf, np.inf)
    low, high = shape.world.low, shape.world.high
    wide = high - low > WIDE_RANGE
    low = np.where(wide, np.maximum(low, ends.min(0) - config.unlimited_range), low)
    high = np.where(wide, np.minimum(high, ends.max(0) + config.unlimited_range), high)
    world = shape.world._replace(low=low, high=high, margin=config.min_margin, self_margin=config.self_margin)
    usable = [free(world, q) for q in ends]
    keep = [float(depth[i]) for i in range(len(ends)) if usable[i]]
    margin = max(config.min_margin, min([config.margin, *keep]) - 1e-9)
    gaps = [float(gap[i]) for i in range(len(ends)) if usable[i]]
    return world._replace(
        margin=margin, self_margin=max(config.self_margin, min([0.002, *gaps]) - 1e-9)
    ), usable
