"""The `isdf` commands on a map file, for people and for machines, and what the file says about itself."""

import datetime
import json

import numpy as np
import pytest
import torch

from isdf import CheckpointError, ConfigError, IsdfConfig, IsdfMapper, load_map, mapfile
from isdf.cli import main
from isdf.mapfile import FILE_VERSION, read, write
from isdf.voxel import ExactMapper
from tests.isdf.rooms import furnished_orbit


@pytest.fixture(scope="module")
def map_path(tmp_path_factory):
    mapper = ExactMapper()
    for frame in furnished_orbit(12):
        mapper.integrate(frame)
    path = tmp_path_factory.mktemp("run") / "map.safetensors"
    mapper.save(path, {"source": "the furnished room"})
    return path


def run(monkeypatch, capsys, *words: object) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["isdf", *map(str, words)])
    code = 0
    try:
        main()
    except SystemExit as end:
        code = int(end.code or 0)
    captured = capsys.readouterr()
    return code, captured.out.strip(), captured.err.strip()


def test_the_header_tells_units_frame_bounds_and_where_the_map_comes_from(map_path) -> None:
    header = mapfile.header(map_path)
    assert header["file_version"] == FILE_VERSION and header["units"] == "metres"
    assert "cameras look along z" in header["frame"] and header["source"] == "the furnished room"
    assert header["bounds"] == load_map(map_path).bounds.tolist() and header["frames_seen"] == 12
    assert header["package"]["name"] == "isdf-planning" and header["package"]["version"] != "unknown"
    age = datetime.datetime.now(datetime.timezone.utc) - datetime.datetime.fromisoformat(header["created"])
    assert datetime.timedelta(0) <= age < datetime.timedelta(hours=1)
    assert header["tensors"]["bounds"] == {"dtype": "F32", "shape": [2, 3]}


def test_info_prints_the_header(map_path, monkeypatch, capsys) -> None:
    code, text, _ = run(monkeypatch, capsys, "info", map_path.parent)
    assert code == 0 and "source: the furnished room" in text and "units: metres" in text
    code, text, _ = run(monkeypatch, capsys, "info", map_path, "--json")
    assert json.loads(text)["bounds"] == mapfile.header(map_path)["bounds"] and "\n" not in text


def _text(path):
    path.write_text("x,y,z\n0,0,1\n")


def _pickled(path):
    np.save(path, np.array([{}]), allow_pickle=True)


def _several(path):
    with path.open("wb") as file:
        np.savez(file, points=np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("write_points", "fault"),
    [
        pytest.param(_text, "magic string is not correct", id="text"),
        pytest.param(_several, "magic string is not correct", id="npz"),
        pytest.param(_pickled, "Object arrays cannot be loaded", id="pickled"),
        pytest.param(lambda path: None, "No such file", id="missing"),
        pytest.param(lambda path: path.mkdir(), "Is a directory", id="folder"),
        pytest.param(lambda path: np.save(path, np.zeros(3)), "got the shape (3,)", id="one-point"),
    ],
)
def test_points_that_cannot_be_read_are_said_so_in_one_line(
    write_points, fault, map_path, tmp_path, monkeypatch, capsys
) -> None:
    points, out = tmp_path / "points.npy", tmp_path / "a.npz"
    write_points(points)
    code, _, error = run(monkeypatch, capsys, "query", map_path, "--points", points, "--out", out)
    assert code == 2 and fault in error and str(points) in error and "\n" not in error
    assert "(N, 3)" in error and not out.exists()


def test_export_writes_and_reports(map_path, tmp_path, monkeypatch, capsys) -> None:
    out = tmp_path / "deep" / "grid.npz"
    words = ("export", map_path, "--format", "npz", "--out", out, "--spacing", 0.2, "--json")
    code, text, _ = run(monkeypatch, capsys, *words)
    report = json.loads(text)
    with np.load(out, allow_pickle=False) as grid:
        assert code == 0 and report["shape"] == list(grid["distance"].shape)
        assert json.loads(str(grid["header"]))["source"] == "the furnished room"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("export", "MAP", "--format", "npz", "--out", "x.npz", "--spacing", "0.0001"), 2, "spacing"),
        (("export", "MAP", "--format", "npz", "--out", "/proc/nowhere/x.npz"), 1, "nowhere"),
        (("info", "nowhere"), 2, "no such file"),
        (("map", "--resume", "nowhere", "--seed", "3"), 2, "leave all other options"),
        (("map",), 2, "give a sequence"),
        (("map", "nowhere", "--out", "x", "--checkpoint-every", "0"), 2, "must be positive"),
    ],
)
def test_faults_are_one_line_for_people_and_one_for_machines(
    words, code, said, map_path, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [map_path if word == "MAP" else word for word in words]
    found, out, error = run(monkeypatch, capsys, *words)
    assert found == code and said in error and "\n" not in error and out == ""
    found, out, error = run(monkeypatch, capsys, *words, "--json")
    assert found == code and said in json.loads(error)["message"] and out == ""


def test_a_misspelled_option_is_answered_with_the_right_one(map_path, monkeypatch, capsys) -> None:
    code, _, error = run(monkeypatch, capsys, "map", "x", "--out", "y", "--steps-per-fram", 3)
    assert code == 2 and "--steps-per-frame" in error
    code, out, error = run(monkeypatch, capsys, "map", "x", "--out", "y", "--steps-per-fram", 3, "--json")
    assert code == 2 and "--steps-per-frame" in json.loads(error)["message"] and out == ""


@pytest.mark.parametrize(("word", "meant"), [("exprt", "export"), ("qeury", "query"), ("maps", "map")])
def test_a_misspelled_command_is_answered_with_the_right_one(word, meant, monkeypatch, capsys) -> None:
    code, _, error = run(monkeypatch, capsys, word, "x")
    assert code == 2 and f"did you mean {meant}?" in error and "map, query, export, info" in error
    code, _, error = run(monkeypatch, capsys, "zzz", "x")
    assert code == 2 and "did you mean" not in error and "map, query, export, info" in error


@pytest.mark.parametrize("words", [("--help",), ("map", "--help"), ("export", "--help"), ("info", "--help")])
def test_help_fits_a_narrow_terminal(words, monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    code, text, _ = run(monkeypatch, capsys, *words)
    assert code == 0 and max(len(line) for line in text.splitlines()[2:]) <= 80
    assert text.count("\n") < 110


def test_newer_damaged_and_oversized_files_are_refused(map_path, tmp_path) -> None:
    header = mapfile.header(map_path)
    tensors, _ = read(map_path, header["format"], header["version"])
    path = tmp_path / "m"
    write(path, tensors, header)
    good = path.read_bytes()
    newer = good.replace(b'file_version\\": 1', b'file_version\\": 9')
    assert newer != good
    flipped = bytearray(good)
    flipped[-7] ^= 4
    huge = good.replace(b'"shape":[2,3]', b'"shape":[2,3000000000]')
    long = (1 << 40).to_bytes(8, "little") + good[8:]
    for version, fault in ((99, "99 is newer than"), (-1, "-1 is older than"), ("1", "'1' is no version")):
        write(path, tensors, header | {"version": version})
        with pytest.raises(CheckpointError, match=fault):
            load_map(path)
    for data, fault in (
        (newer, "file version 9 is newer .*update the package"),
        (bytes(flipped), "checksum"),
        (good[:-1], "are there"),
        (huge, "not a readable map"),
        (long, "a header of"),
    ):
        path.write_bytes(data)
        with pytest.raises(CheckpointError, match=fault):
            load_map(path)


def test_a_header_cannot_claim_a_network_that_is_not_there(tmp_path) -> None:
    mapper = IsdfMapper(IsdfConfig(first_frame_steps=1))
    mapper.integrate(furnished_orbit(12)[0])
    path = tmp_path / "m"
    mapper.save(path)
    header = mapfile.header(path)
    tensors, _ = read(path, header["format"], header["version"])
    header["config"]["network"]["width"] = 10**6
    write(path, tensors, header)
    with pytest.raises(CheckpointError, match="should have over"):
        load_map(path)


def test_a_map_loads_where_it_is_told_to(map_path, tmp_path) -> None:
    with pytest.raises(ConfigError, match="CPU only"):
        load_map(map_path, "cuda")
    mapper = IsdfMapper(IsdfConfig(first_frame_steps=1))
    mapper.integrate(furnished_orbit(12)[0])
    mapper.save(tmp_path / "m")
    assert load_map(tmp_path / "m", torch.device("cpu")).network.origin.device.type == "cpu"
