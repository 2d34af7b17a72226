"""Exports: other programs' readers find the room where it is, and nothing unseen passes for free."""

import functools
import json

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from isdf import ConfigError
from isdf.export import FORMATS, ExportConfig, export
from isdf.field import GridField
from isdf.voxel import ExactMapper
from tests.isdf.rooms import furnished_orbit, furnished_room

NAMES = {
    "ply": "m.ply",
    "glb": "m.glb",
    "npz": "g.npz",
    "mha": "g.mha",
    "mhd": "g.mhd",
    "pointcloud": "c.ply",
    "ros-map": "p.yaml",
}


@functools.lru_cache(maxsize=1)
def room():
    mapper = ExactMapper()
    for frame in furnished_orbit(12, 160):
        mapper.integrate(frame)
    mapper.refresh()
    return mapper.field()


def read_mha(path):
    """As ITK reads it: header lines, then x-fastest floats."""
    data = path.read_bytes()
    end = data.index(b"\n", data.index(b"ElementDataFile")) + 1
    fields = dict(line.split(" = ") for line in data[:end].decode().splitlines())
    raw = (
        data[end:]
        if fields["ElementDataFile"] == "LOCAL"
        else (path.parent / fields["ElementDataFile"]).read_bytes()
    )
    sizes = [int(n) for n in fields["DimSize"].split()]
    values = np.frombuffer(raw, "<f4").reshape(sizes[::-1]).transpose(2, 1, 0)
    return values, np.array(fields["Offset"].split(), float), float(fields["ElementSpacing"].split()[0])


def test_grids_hold_the_distances_of_their_places(tmp_path) -> None:
    x, y, z = torch.meshgrid(torch.arange(5.0), torch.arange(7.0), torch.arange(9.0), indexing="ij")
    field = GridField(0.1 * (x + 2 * y - 3 * z), torch.tensor([1.0, -2.0, 0.5]), 0.1)
    config, done = ExportConfig(spacing=0.05, padding=0.0), []
    export(field, tmp_path / "g.npz", "npz", config, {"format": "x"}, lambda n, whole: done.append(n / whole))
    export(field, tmp_path / "g.mha", "mha", config)
    export(field, tmp_path / "h.mhd", "mhd", config)
    arrays = np.load(tmp_path / "g.npz", allow_pickle=False)
    assert done[-1] == 1.0 and sorted(done) == done and json.loads(str(arrays["header"])) == {"format": "x"}
    assert "confidence" not in arrays
    for values, origin, spacing in (
        (arrays["distance"], arrays["origin"], float(arrays["spacing"])),
        read_mha(tmp_path / "g.mha"),
        read_mha(tmp_path / "h.mhd"),
    ):
        assert values.shape[0] < values.shape[1] < values.shape[2]
        index = np.indices(values.shape).reshape(3, -1)
        points = torch.from_numpy((origin[:, None] + spacing * index).T.astype(np.float32))
        np.testing.assert_allclose(values.ravel(), field.distance(points).numpy(), atol=1e-5)
    export(room(), tmp_path / "room.npz", "npz", ExportConfig(spacing=0.1))
    assert set(np.unique(np.load(tmp_path / "room.npz")["confidence"])) == {0.0, 1.0}


def test_meshes_and_clouds_lie_on_the_surfaces(tmp_path) -> None:
    for kind in ("ply", "glb", "pointcloud"):
        report = export(room(), tmp_path / NAMES[kind], kind)
        loaded = trimesh.load(tmp_path / NAMES[kind])
        vertices = np.asarray(loaded.to_geometry().vertices if kind == "glb" else loaded.vertices)
        assert len(vertices) > 1000 and report["files"] == [str(tmp_path / NAMES[kind])]
        gap = furnished_room()(torch.from_numpy(vertices.astype(np.float32))).abs()
        assert gap.median() < 0.02 and gap.mean() < 0.04
    normals = np.frombuffer((tmp_path / "c.ply").read_bytes().split(b"end_header\n", 1)[1], "<f4")
    points, normals = np.split(normals.reshape(-1, 6), 2, axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
    rise = furnished_room()(torch.from_numpy(points + 0.1 * normals)) - furnished_room()(
        torch.from_numpy(points)
    )
    assert (rise > 0.03).float().mean() > 0.8  # out of the surface, into the room


def read_plan(path):
    """As map_server does it."""
    lines = [line.split(": ") for line in path.read_text().splitlines() if line[0] != "#"]
    values = dict(lines)
    occupancy = (255 - np.array(Image.open(path.parent / values["image"]), float)) / 255
    state = np.full(occupancy.shape, "unknown", dtype="U8")
    state[occupancy > float(values["occupied_thresh"])] = "occupied"
    state[occupancy < float(values["free_thresh"])] = "free"
    return state, json.loads(values["origin"]), float(values["resolution"])


def state_at(plan, x: float, y: float) -> str:
    state, origin, resolution = plan
    row = state.shape[0] - 1 - int((y - origin[1]) / resolution)
    return str(state[row, int((x - origin[0]) / resolution)])


def test_a_floor_plan_tells_occupied_free_and_unknown(tmp_path) -> None:
    export(room(), tmp_path / "p.yaml", "ros-map", ExportConfig(band=(0.3, 1.1)))
    plan = read_plan(tmp_path / "p.yaml")
    assert state_at(plan, 1.1, 0.5) == "occupied"  # the table
    assert state_at(plan, -0.6, -1.0) == "occupied"  # the ball
    assert state_at(plan, -1.4, 0.3) == "free"
    for wall in ((-2.52, -0.5), (2.52, -0.5), (0.0, -2.02), (1.0, 2.02)):
        assert state_at(plan, *wall) == "occupied"
    assert state_at(plan, -2.1, 1.4) != "free"  # within the cupboard, which no camera saw
    export(room(), tmp_path / "q.yaml", "ros-map", ExportConfig(band=(0.85, 1.1)))
    assert state_at(read_plan(tmp_path / "q.yaml"), 1.1, 0.5) == "free"  # over the table


def test_a_floor_plan_follows_up(tmp_path) -> None:
    """A world whose y points down, as a camera's: the plan is of x and z."""
    n = torch.arange(41) * 0.1 - 2
    pole = (n[:, None] - 1.0).square() + (n[None] + 0.5).square()  # along y, at x = 1, z = -0.5
    values = pole.sqrt()[:, None].expand(41, 41, 41) - 0.2
    field = GridField(values.contiguous(), torch.tensor([-2.0, -2.0, -2.0]), 0.1)
    report = export(
        field, tmp_path / "p.yaml", "ros-map", ExportConfig(padding=0.0, up=(0.0, -1.0, 0.0), band=(0.0, 1.0))
    )
    assert report["cells"]["unknown"] == 0
    comment = (tmp_path / "p.yaml").read_text().splitlines()[0]
    basis = np.array([[float(w) for w in part.split()[-3:]] for part in comment.split("; ")])
    place = basis @ [1.0, 0.0, -0.5]
    plan = read_plan(tmp_path / "p.yaml")
    assert state_at(plan, *place[:2]) == "occupied" and state_at(plan, place[0] - 0.6, place[1]) == "free"


@pytest.mark.parametrize("kind", FORMATS)
def test_a_failed_export_leaves_the_old_file_and_no_litter(kind, tmp_path, monkeypatch) -> None:
    path = tmp_path / NAMES[kind]
    path.write_text("old")
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        export(room(), path, kind, ExportConfig(spacing=0.15))
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("kind", "name", "config", "fault"),
    [
        ("npz", "g.npz", {"spacing": 0.001}, "choose a spacing of"),
        ("ros-map", "p.yaml", {"spacing": 1e-5}, "larger spacing"),
        ("ros-map", "p.yaml", {"band": (0.0, 1e12)}, "larger spacing"),
        ("ros-map", "p.pgm", {}, "call it p.yaml"),
        ("mha", "g.raw", {}, "call the file g.mha"),
        ("vdb", "g.vdb", {}, "choose one of"),
        ("npz", "g.npz", {"spacing": -1.0}, "positive spacing"),
        ("npz", "g.npz", {"padding": float("nan")}, "finite"),
        ("ros-map", "p.yaml", {"band": (1.0, 1.0)}, "band"),
        ("ros-map", "p.yaml", {"up": (0.0, 0.0, 0.0)}, "direction"),
    ],
)
def test_impossible_exports_are_refused(kind, name, config, fault, tmp_path) -> None:
    with pytest.raises(ConfigError, match=fault):
        export(room(), tmp_path / name, kind, ExportConfig(**config))
    assert list(tmp_path.iterdir()) == []
