"""The check that all configurations share: their numbers are numbers."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from .errors import ConfigError

# Whole numbers up to here are exact as floating-point ones.
LARGEST = 1 << 53


def require_finite(config: Any, unlimited: tuple[str, ...] = ()) -> None:
    """Refuse NaN, infinity and absurdly large numbers in a configuration's fields.

    Args:
        config: a dataclass.
        unlimited: fields that may be infinite.

    Raises:
        ConfigError: names the field.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if not isinstance(value, int | float):
            continue
        endless = isinstance(value, float) and value == math.inf and field.name in unlimited
        if not abs(value) <= LARGEST and not endless:
            raise ConfigError(f"{field.name} must be a finite number, got {value:.6g}"[:200])
