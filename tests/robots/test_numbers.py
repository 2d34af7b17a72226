"""No configuration takes NaN for a number."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil

import pytest

import robots
from robots.errors import RobotError
from robots.numbers import refuse_nan


def configs() -> list[type]:
    """All that can be imported here and have defaults."""
    found = {}
    for module in pkgutil.walk_packages(robots.__path__, "robots."):
        if module.name.endswith("__main__"):
            continue
        try:
            names = vars(importlib.import_module(module.name))
        except ImportError:  # an optional extra is missing
            continue
        found |= {n: c for n, c in names.items() if n.endswith("Config") and dataclasses.is_dataclass(c)}
    return [found[name] for name in sorted(found)]


@pytest.mark.parametrize("config", configs(), ids=lambda config: config.__name__)
def test_every_number_of_a_configuration_must_be_one(config: type) -> None:
    try:
        good = config()
    except TypeError:
        pytest.skip("it has no defaults")
    for field in dataclasses.fields(config):
        if isinstance(getattr(good, field.name), float):
            with pytest.raises(RobotError, match=field.name):
                dataclasses.replace(good, **{field.name: math.nan})


def test_nan_in_a_tuple_is_refused_and_what_is_no_number_is_left_alone() -> None:
    @dataclasses.dataclass
    class Odd:
        pairs: tuple
        limit: float = math.inf
        name: str = "nan"

    refuse_nan(Odd(((1.0, 2), "nan", None)))
    with pytest.raises(RobotError, match=r"Odd: pairs must be a number"):
        refuse_nan(Odd(((1.0, 2), (3.0, math.nan))))
