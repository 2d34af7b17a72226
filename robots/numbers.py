"""The check that all configurations share: no number in them is NaN, which passes most comparisons unnoticed."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from robots.errors import RobotError


def refuse_nan(config: Any) -> None:
    """Refuse NaN in the numbers of a dataclass, and in its tuples of numbers.

    Raises:
        RobotError: names the field.
    """
    for field in dataclasses.fields(config):
        if _holds_nan(getattr(config, field.name)):
            raise RobotError(f"{type(config).__name__}: {field.name} must be a number, got NaN.")


def _holds_nan(value: Any) -> bool:
    if isinstance(value, tuple):
        return any(map(_holds_nan, value))
    return isinstance(value, float) and math.isnan(value)
