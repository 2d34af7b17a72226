"""No configuration takes NaN, or infinity where it means nothing."""

import dataclasses
import math
import typing

import pytest

from isdf import ConfigError
from isdf.numbers import LARGEST
from tests.fuzz.configs import MAY_BE_INFINITE, WHOLE

FLOATS = [
    (kind, field.name)
    for kind in WHOLE
    for field in dataclasses.fields(kind)
    if typing.get_type_hints(kind)[field.name] is float
]


@pytest.mark.parametrize(("kind", "name"), FLOATS, ids=lambda v: v if isinstance(v, str) else v.__name__)
def test_what_is_no_number_is_refused(kind, name) -> None:
    for bad in (math.nan, -math.inf, *([] if name in MAY_BE_INFINITE else [math.inf])):
        with pytest.raises(ConfigError, match=name if kind.__name__ != "ExportConfig" else "finite"):
            kind(**{name: bad})


def test_absurd_sizes_are_refused() -> None:
    for kind in WHOLE:
        for field in dataclasses.fields(kind):
            if typing.get_type_hints(kind)[field.name] is int:
                with pytest.raises(ConfigError):
                    kind(**{field.name: 100 * LARGEST})
