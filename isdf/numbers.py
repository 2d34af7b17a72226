"""The check that all configurations share: their numbers are numbers."""

from __future__ import annotations

import dataclasses
import math
from numbers import Integral, Real
from typing import Any

from .errors import ConfigError

# What a field of each type may hold; numpy's numbers are among them.
KINDS: dict[str, Any] = {"int": Integral, "float": Real, "bool": bool}
OPTIONAL = " | None"
# Whole numbers up to here are exact as floating-point ones.
LARGEST = 1 << 53


def require_finite(config: Any, unlimited: tuple[str, ...] = ()) -> None:
    """Refuse NaN, infinity, absurdly large numbers and what is no number in a configuration's numeric fields.

    Args:
        config: a dataclass.
        unlimited: fields that may be infinite.

    Raises:
        ConfigError: names the field.
    """
    for field in dataclasses.fields(config):
        value: Any = getattr(config, field.name)
        declared = getattr(field.type, "__name__", str(field.type))
        kind = KINDS.get(declared.removesuffix(OPTIONAL))
        if kind is None or (value is None and declared.endswith(OPTIONAL)):
            continue
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise ConfigError(f"{field.name} must be of type {field.type}, got {value!r}"[:200])
        if value == math.inf and field.name in unlimited:
            continue
        if not -LARGEST <= value <= LARGEST:
            raise ConfigError(f"{field.name} must be a finite number, got {value!r}"[:200])
