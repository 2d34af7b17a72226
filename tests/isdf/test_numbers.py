"""No configuration takes NaN, or infinity where it means nothing."""

import dataclasses
import math
import typing

import numpy as np
import pytest

from isdf import ConfigError
from isdf.numbers import LARGEST, require_finite
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


@dataclasses.dataclass(frozen=True)
class Plain:
    """Its types are not checked at run time, as none are outside the tests."""

    length: "float" = 1.0
    count: "int" = 1
    exact: "bool" = True
    period: "float | None" = None


@pytest.mark.parametrize(
    "bad",
    [
        {"length": None}, {"length": "1"}, {"length": True}, {"count": 1.0}, {"exact": 1}, {"count": None},
        {"period": "1"}, {"period": True},
    ],
)  # fmt: skip
def test_what_is_of_another_type_is_refused(bad) -> None:
    require_finite(Plain(np.float32(2.0), np.int64(3), False))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=f"{next(iter(bad))} must be of type"):
        require_finite(Plain(**bad))
