"""What every fuzz property asks: whatever comes in, the answer is a result or the package's own error."""

from __future__ import annotations

import contextlib
import resource
from collections import Counter
from collections.abc import Iterator

import torch

from isdf import IsdfError
from isdf.methods import OnlineMapper

# Inputs by property and by what became of them.
OUTCOMES: Counter[str] = Counter()
# Most memory that one input may take beyond what was used before [bytes].
MEMORY = 400 << 20


@contextlib.contextmanager
def only_own_errors(name: str) -> Iterator[None]:
    """Let the package's errors pass; count; refuse an input that takes much memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        yield
        OUTCOMES[f"{name}: accepted"] += 1
    except IsdfError as error:
        assert str(error), "an error must say what is wrong"
        OUTCOMES[f"{name}: {type(error).__name__}"] += 1
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    assert grown < MEMORY, f"this input took {grown / 2**20:.0f} MB"


def assert_answers(mapper: OnlineMapper) -> None:
    """A map answers with numbers at finite points."""
    lower, upper = mapper.bounds
    points = lower + torch.rand(20, 3) * (upper - lower)
    distance, gradient = mapper.field().distance_and_gradient(points)
    assert bool(torch.isfinite(points).all()), f"bounds {mapper.bounds}"
    assert bool(torch.isfinite(distance).all() and torch.isfinite(gradient).all())
