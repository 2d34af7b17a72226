"""Map files that are damaged, or that lie with a matching checksum."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path
from typing import Any

import torch
from hypothesis import given
from hypothesis import strategies as st

from isdf import CheckpointError, MapperConfig, load_map, mapfile
from isdf.methods import new_mapper
from isdf.voxel import KinectFusionConfig
from tests.fuzz.accepts import OUTCOMES, only_own_errors
from tests.fuzz.readers import COARSE, TINY
from tests.isdf.rooms import furnished_orbit

CONFIGS = {
    "default": MapperConfig(),
    "isdf": TINY,
    "exact": COARSE,
    "kinectfusion": KinectFusionConfig(voxel=0.25, max_voxels=200_000),
}
JSON = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.sampled_from([0, -1, 2**31, 2**40, 2**63, 10**30, 1e308, "", "world"]),
        st.floats(),
        st.text(max_size=5),
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


@functools.cache
def map_bytes(method: str) -> bytes:
    """A small map file of each method."""
    mapper = new_mapper(CONFIGS[method])
    for frame in furnished_orbit(12)[:2]:
        mapper.integrate(frame)
    with tempfile.TemporaryDirectory() as place:
        mapper.save(Path(place) / "m", {"run": {"options": {}, "report": {}}})
        return (Path(place) / "m").read_bytes()


@given(
    st.sampled_from(sorted(CONFIGS)),
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=4),
    st.one_of(st.none(), st.floats(0, 1, exclude_max=True)),
    st.integers(0, 1),
)
def damaged_files(method: str, flips: list[tuple[float, int]], cut: float | None, early: int) -> None:
    """Flipped bits and missing ends never load."""
    data = bytearray(map_bytes(method))
    span = 4000 if early else len(data)
    for place, bits in flips:
        data[int(place * span)] ^= bits
    if cut is not None:
        data = data[: int(cut * len(data))]
    if data == map_bytes(method):
        return
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "m"
        path.write_bytes(data)
        try:
            load_map(path)
        except CheckpointError as error:
            assert str(path) in str(error)
            OUTCOMES[f"damaged {method}: refused"] += 1
        else:
            raise AssertionError("a damaged file was loaded")


@st.composite
def lies(draw: st.DrawFn, header: dict[str, Any]) -> dict[str, Any]:
    """A header with the value in one place, at any depth, exchanged."""
    if not header or (draw(st.booleans()) and draw(st.booleans())):
        return draw(JSON)
    name = draw(st.sampled_from(sorted(header)))
    inner = header[name]
    if isinstance(inner, dict) and draw(st.booleans()):
        return header | {name: draw(lies(inner))}
    if isinstance(inner, list) and inner and draw(st.booleans()):
        return header | {name: [draw(JSON), *inner[1:]]}
    return header | {name: draw(JSON)}


@given(st.data(), st.sampled_from(sorted(CONFIGS)))
def lying_headers(data: st.DataObject, method: str) -> None:
    """A header that does not fit is refused, without taking memory for what it claims."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "m"
        path.write_bytes(map_bytes(method))
        header = mapfile.header(path)
        tensors, _ = mapfile.read(path, header["format"], header["version"])
        lie = data.draw(lies(header))
        if not isinstance(lie, dict):
            return
        mapfile.write(path, tensors, lie)
        _use(path, f"lying header {method}")


@given(st.data(), st.sampled_from(sorted(CONFIGS)))
def lying_tensors(data: st.DataObject, method: str) -> None:
    """Tensors that are missing, of other shapes or types, or not finite are refused or do no harm."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "m"
        path.write_bytes(map_bytes(method))
        header = mapfile.header(path)
        tensors, _ = mapfile.read(path, header["format"], header["version"])
        name = data.draw(st.sampled_from(sorted(tensors)))
        kind = data.draw(st.sampled_from(["missing", "type", "shape", "values", "empty"]))
        value = tensors.pop(name)
        if kind == "type":
            dtype = data.draw(st.sampled_from([torch.float64, torch.int64, torch.bool, torch.float16]))
            tensors[name] = value.to(dtype)
        elif kind == "shape":
            shape = data.draw(st.lists(st.integers(0, 4), max_size=4))
            tensors[name] = torch.ones(shape, dtype=value.dtype)
        elif kind == "values":
            fill = data.draw(st.sampled_from([float("nan"), float("inf"), 1e38, -1.0]))
            tensors[name] = (
                torch.full(value.shape, fill).to(value.dtype) if value.is_floating_point() else value * 0
            )
        elif kind == "empty":
            tensors[name] = value.reshape(-1)[:0].clone()
        mapfile.write(path, tensors, header)
        _use(path, f"lying tensors {method}")


def _use(path: Path, name: str) -> None:
    with only_own_errors(name):
        mapper = load_map(path)
        mapper.bounds  # noqa: B018
        mapper.step()
        mapper.field().distance(torch.rand(5, 3))
        mapper.integrate(furnished_orbit(12)[2])
        mapper.save(path)
        load_map(path)
