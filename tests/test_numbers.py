"""No configuration of planning and robots takes NaN for a number; see tests/isdf/test_numbers.py for those of isdf."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil
from types import ModuleType

import numpy as np
import pytest

import planning.numbers
import robots.numbers
from planning.errors import ConfigError
from robots.errors import RobotError

REFUSALS = {ConfigError: planning.numbers.refuse_nan, RobotError: robots.numbers.refuse_nan}


def configs(package: ModuleType) -> list[type]:
    """All of a package that can be imported here."""
    found = {}
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if module.name.endswith("__main__"):
            continue
        try:
            names = vars(importlib.import_module(module.name))
        except ImportError:  # an optional extra is missing
            continue
        found |= {n: c for n, c in names.items() if n.endswith("Config") and dataclasses.is_dataclass(c)}
    return [found[name] for name in sorted(found)]


@pytest.mark.parametrize(
    ("config", "error"),
    [(c, ConfigError) for c in configs(planning)] + [(c, RobotError) for c in configs(robots)],
    ids=lambda value: value.__name__,
)
def test_every_number_of_a_configuration_must_be_one(config: type, error: type[Exception]) -> None:
    try:
        good = config()
    except TypeError:
        pytest.skip("it has no defaults")
    for field in dataclasses.fields(config):
        if isinstance(getattr(good, field.name), float):
            with pytest.raises(error, match=field.name):
                dataclasses.replace(good, **{field.name: math.nan})


@pytest.mark.parametrize("error", REFUSALS, ids=lambda error: error.__name__)
def test_nan_in_a_tuple_is_refused_and_what_is_no_number_is_left_alone(error: type[Exception]) -> None:
    @dataclasses.dataclass
    class Odd:
        pairs: tuple
        limit: float = math.inf
        name: str = "nan"

    refuse_nan = REFUSALS[error]
    refuse_nan(Odd(((1.0, 2), "nan", None)))
    refuse_nan(Odd((np.float64(1.0),), np.float64(2.0)))
    with pytest.raises(error, match=r"Odd: pairs must be a number"):
        refuse_nan(Odd(((1.0, 2), (3.0, math.nan))))
