"""Configurations with any numbers in them."""

from __future__ import annotations

import dataclasses
import math
import typing
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from isdf import IsdfConfig, KeyframeConfig, LossConfig, MapperConfig, NetworkConfig, SamplingConfig
from isdf.export import ExportConfig
from isdf.methods import new_mapper
from isdf.voxel import ExactConfig, KinectFusionConfig
from tests.fuzz.accepts import assert_answers, only_own_errors
from tests.fuzz.readers import COARSE, TINY
from tests.isdf.rooms import furnished_orbit

PARTS = (NetworkConfig, SamplingConfig, LossConfig, KeyframeConfig, IsdfConfig)
WHOLE = (*PARTS, MapperConfig, ExactConfig, KinectFusionConfig, ExportConfig)
FLOATS = st.one_of(
    st.floats(), st.sampled_from([0.0, -1.0, 1e-30, 1e30, math.nan, math.inf]), st.floats(0.01, 2)
)
INTS = st.one_of(st.integers(-3, 40), st.integers(), st.sampled_from([2**31, 2**63, 10**20]))
# What is unbounded on purpose.
MAY_BE_INFINITE = {"force_after", "rebuild_period", "guess_period", "refresh_period"}


def values(hint: Any, ints: st.SearchStrategy[int]) -> st.SearchStrategy[Any] | None:
    """Values of a field's type; None for nested configurations."""
    if typing.get_origin(hint) is typing.Literal:
        return st.sampled_from(typing.get_args(hint))
    if typing.get_origin(hint) is tuple:
        return st.tuples(*(values(one, ints) for one in typing.get_args(hint)))
    return {int: ints, float: FLOATS, bool: st.booleans()}.get(hint)


def numbers(value: Any) -> list[float]:
    """All floats in a field's value."""
    inner = value if isinstance(value, tuple) else (value,)
    return [one for one in inner if isinstance(one, float)]


@given(st.data(), st.sampled_from(WHOLE))
def any_numbers(data: st.DataObject, kind: type) -> None:
    """A configuration with impossible numbers is a ConfigError; none of those accepted holds a NaN or inf."""
    hints = typing.get_type_hints(kind)
    names = data.draw(st.lists(st.sampled_from([f.name for f in dataclasses.fields(kind)]), max_size=3))
    given_values = {n: data.draw(one) for n in names if (one := values(hints[n], INTS)) is not None}
    with only_own_errors(kind.__name__):
        config = kind(**given_values)
        for field in dataclasses.fields(config):
            for number in numbers(getattr(config, field.name)):
                assert not math.isnan(number), f"{field.name} is NaN"
                assert math.isfinite(number) or field.name in MAY_BE_INFINITE, f"{field.name} is {number}"


@given(st.data(), st.sampled_from([*PARTS, MapperConfig, ExactConfig, KinectFusionConfig]))
def any_config_maps(data: st.DataObject, kind: type) -> None:
    """What was accepted maps: two frames, and finite answers or an error of the package's own."""
    hints = typing.get_type_hints(kind)
    names = data.draw(st.lists(st.sampled_from([f.name for f in dataclasses.fields(kind)]), max_size=3))
    small = st.integers(0, 12)
    changed = {n: data.draw(one) for n in names if (one := values(hints[n], small)) is not None}
    with only_own_errors(f"mapping with {kind.__name__}"):
        if kind is ExactConfig:
            config: Any = dataclasses.replace(COARSE, **changed)
        elif kind is KinectFusionConfig:
            config = dataclasses.replace(KinectFusionConfig(voxel=0.25, max_voxels=200_000), **changed)
        elif kind is MapperConfig:
            config = dataclasses.replace(MapperConfig(max_bricks=200_000), **changed)
        elif kind is IsdfConfig:
            config = dataclasses.replace(TINY, **changed)
        else:
            (part,) = [f.name for f in dataclasses.fields(TINY) if isinstance(getattr(TINY, f.name), kind)]
            config = dataclasses.replace(TINY, **{part: dataclasses.replace(getattr(TINY, part), **changed)})
        mapper = new_mapper(config)
        for frame in furnished_orbit(12)[:2]:
            mapper.integrate(frame)
        if not changed.keys() & {"learning_rate", "weight_decay"} and kind not in (LossConfig, NetworkConfig):
            assert_answers(mapper)
