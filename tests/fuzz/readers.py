"""Recordings with something broken in them: bytes, numbers, words, files."""

from __future__ import annotations

import functools
import re
import tempfile
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from isdf import FrameError, IsdfConfig, IsdfMapper, KeyframeConfig, Mapper, NetworkConfig, SamplingConfig
from isdf.datasets import SequenceWriter, open_sequence
from isdf.voxel import ExactConfig, ExactMapper
from tests.fuzz.accepts import assert_answers, only_own_errors
from tests.isdf.rooms import furnished_orbit
from tests.isdf.test_readers import write_polycam, write_replica, write_scannet, write_seven_scenes, write_tum

TINY = IsdfConfig(
    network=NetworkConfig(width=8, hidden_layers=2, skip_layer=2, frequency_octaves=1),
    sampling=SamplingConfig(rays_per_frame=5, stratified=2, near_surface=1),
    keyframes=KeyframeConfig(test_rays=10, test_samples=5),
    first_frame_steps=1,
    steps_per_frame=1,
    keyframe_steps=0,
)
COARSE = ExactConfig(voxel=0.25, truncation=0.3, max_voxels=200_000, rebuild_period=0.0)


def write_recorded(folder: Path) -> None:
    frames = furnished_orbit(12)[:3]
    writer = SequenceWriter(folder, frames[0].camera)
    for frame in frames:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())


LAYOUTS = {
    "recorded": write_recorded,
    "replica": lambda folder: write_replica(folder, shared=False),
    "scannet": write_scannet,
    "7-scenes": write_seven_scenes,
    "rgbd_freiburg1": write_tum,
    "polycam": write_polycam,
}
NUMBERS = st.one_of(
    st.sampled_from(["nan", "inf", "-inf", "NaN", "Infinity", "1e308", "-1e308", "1e30", "1e19", "1e-320"]),
    st.sampled_from(["0", "-1", "65536", "99999999999999999999", "true", "null", "[]", "{}", '"x"', "x", ""]),
    st.floats(allow_nan=True).map(repr),
    st.integers(-(10**12), 10**12).map(str),
)
WORD = re.compile(r"-?\d+\.?\d*(?:e[+-]?\d+)?")


@st.composite
def damages(draw: st.DrawFn) -> tuple[str, float, float, bytes]:
    """A kind of damage, the file it is done to and the place in it (both as shares), and new content."""
    kind = draw(st.sampled_from(["number", "number", "bytes", "truncate", "delete", "empty"]))
    share = st.floats(0, 1, exclude_max=True)
    new = draw(NUMBERS).encode() if kind == "number" else draw(st.binary(min_size=1, max_size=8))
    return kind, draw(share), draw(share), new


def damage(folder: Path, kind: str, which: float, where: float, new: bytes) -> None:
    """Do it; a number is replaced only in a text file."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    if kind == "number":
        files = [p for p in files if p.suffix != ".png"]
    if not files:
        return
    path = files[int(which * len(files))]
    data = path.read_bytes()
    if kind == "delete":
        path.unlink()
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "truncate":
        path.write_bytes(data[: int(where * len(data))])
    elif kind == "bytes":
        at = int(where * len(data))
        path.write_bytes(data[:at] + new + data[at + len(new) :])
    else:
        text = data.decode(errors="replace")
        words = list(WORD.finditer(text))
        if words:
            word = words[int(where * len(words))]
            path.write_text(text[: word.start()] + new.decode() + text[word.end() :])


@functools.cache
def compile_all() -> None:
    """Compiling takes memory and time that are not the input's."""
    for mapper in (Mapper(), IsdfMapper(TINY), ExactMapper(COARSE)):
        for frame in furnished_orbit(12)[:3]:
            mapper.integrate(frame)
        assert_answers(mapper)


@given(st.sampled_from(sorted(LAYOUTS)), st.lists(damages(), min_size=1, max_size=3))
def broken_recordings(layout: str, broken: list[tuple[str, float, float, bytes]]) -> None:
    """Reading and mapping a damaged recording gives a map, or an error of this package's that names the fault."""
    compile_all()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / layout
        folder.mkdir()
        LAYOUTS[layout](folder)
        for one in broken:
            damage(folder, *one)
        with only_own_errors(f"recording {layout}"):
            sequence = open_sequence(folder)
            assert len(sequence) >= 1 and 0 < sequence.fps < float("inf")
            mappers = [Mapper(), IsdfMapper(TINY), ExactMapper(COARSE)]
            for index in range(min(len(sequence), 3)):
                with only_own_errors(f"frame {layout}"):
                    frame = sequence[index]
                    for mapper in mappers:
                        before = mapper.frames_seen
                        try:
                            mapper.integrate(frame)
                        except FrameError:
                            assert mapper.frames_seen == before
            for mapper in mappers:
                if mapper.frames_seen:
                    assert_answers(mapper)


@given(st.lists(st.sampled_from(["depth", "poses.txt", "intrinsics.json", "traj.txt", "keyframes/depth"])))
def empty_places(names: list[str]) -> None:
    """A folder with empty files or folders in it is no recording."""
    with tempfile.TemporaryDirectory() as place:
        for name in names:
            path = Path(place) / name
            if "." in name:
                path.touch()
            else:
                path.mkdir(parents=True, exist_ok=True)
        with only_own_errors("empty folder"):
            open_sequence(place)
            raise AssertionError("an empty folder was opened")
