"""Fuzz for a given time: `python -m tests.fuzz --minutes 30`. Ends at the first finding, with how to repeat it."""

from __future__ import annotations

import logging
import resource
import time
import warnings
from dataclasses import dataclass

import torch
import tyro
from hypothesis import HealthCheck, settings
from hypothesis.errors import HypothesisWarning

from tests.fuzz import configs, mapfiles, readers
from tests.fuzz.accepts import OUTCOMES

ADDRESS_SPACE = 12 << 30

PROPERTIES = {
    "readers": (readers.broken_recordings, readers.empty_places),
    "mapfiles": (mapfiles.damaged_files, mapfiles.lying_headers, mapfiles.lying_tensors),
    "configs": (configs.any_numbers, configs.any_config_maps),
}


@dataclass(frozen=True)
class Fuzz:
    """Which properties, and how long."""

    minutes: float = 30.0
    """In all; the properties take turns."""
    only: tuple[str, ...] = tuple(PROPERTIES)
    """readers, mapfiles or configs."""
    examples: int = 100
    """Inputs a turn."""


def main(fuzz: Fuzz) -> None:
    """Take turns until the time is over; print the counts."""
    torch.set_num_threads(1)
    # Beyond this an allocation fails, and names its place, instead of the machine.
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore", HypothesisWarning)
    turn = settings(max_examples=fuzz.examples, deadline=None, suppress_health_check=list(HealthCheck))
    chosen = [turn(one) for name in fuzz.only for one in PROPERTIES[name]]
    end = time.monotonic() + 60 * fuzz.minutes
    try:
        while time.monotonic() < end:
            for one in chosen:
                if time.monotonic() < end:
                    one()
    finally:
        for name, count in sorted(OUTCOMES.items()):
            print(f"{count:8d}  {name}")
        print(f"{sum(OUTCOMES.values()):8d}  inputs in all")


if __name__ == "__main__":
    main(tyro.cli(Fuzz, description=__doc__))
