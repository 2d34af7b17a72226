"""Ground truth as a file: the same numbers back to the last bit, and clear words for what is no truth."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from robots.errors import SceneError
from robots.simulation import SceneField, load_truth, make_scene, save_truth

ROOM = np.array([[-4.0, -3.0, 0.0], [4.0, 3.0, 2.8]])


@pytest.fixture
def path(tmp_path):
    scene = make_scene("home_1")
    save_truth(tmp_path / "truth.json", (*scene.static, *scene.objects), ROOM)
    return tmp_path / "truth.json"


def test_distances_and_room_come_back_exactly(path) -> None:
    truth, scene = load_truth(path), make_scene("home_1")
    assert (
        len({solid.kind for solid in truth.field.primitives}) == 3
    )  # boxes, cylinders and spheres are there
    points = torch.from_numpy(np.random.default_rng(0).uniform(*ROOM, (4000, 3)))
    assert torch.equal(truth.field.distance(points), SceneField(scene).distance(points))
    assert np.array_equal(truth.room, ROOM)
    assert truth.field.names == tuple(s.name for s in (*scene.static, *scene.objects))


def edited(values: dict, change: str) -> object:
    solid = values["solids"][0]
    if change == "no solids":
        values["solids"] = []
    elif change == "no room":
        del values["room"]
    elif change == "room upside down":
        values["room"].reverse()
    elif change == "unknown kind":
        solid["kind"] = "cone"
    elif change == "no pose":
        del solid["pose"]
    elif change == "short pose":
        solid["pose"] = solid["pose"][:3]
    elif change == "nan size":
        solid["size"][1] = float("nan")
    elif change == "negative size":
        solid["size"][1] = -1.0
    elif change == "no name":
        del solid["name"]
    elif change == "twice":
        values["solids"].append(dict(solid))
    return [values] if change == "a list" else values


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("no solids", "at least one solid"),
        ("no room", "keys room and solids"),
        ("a list", "keys room and solids"),
        ("room upside down", "lower corner and then its upper"),
        ("unknown kind", "solid 'floor': kind must be one of box, cylinder, sphere, got 'cone'"),
        ("no pose", "solid 'floor': a box needs pose"),
        ("short pose", "pose must be 4 x 4 finite numbers"),
        ("nan size", "size must be 3 finite numbers"),
        ("negative size", "truth.json: .*floor"),
        ("no name", "solid 0 must be an object with a name"),
        ("twice", "names must be unique, got 'floor'"),
    ],
)
def test_wrong_files_are_refused_by_name(path, change, message) -> None:
    values = json.loads(path.read_text())
    assert values["solids"][0]["name"] == "floor" and values["solids"][0]["kind"] == "box"
    path.write_text(json.dumps(edited(values, change)))
    with pytest.raises(SceneError, match=message) as info:
        load_truth(path)
    assert "truth.json" in str(info.value)


def test_missing_and_broken_files(tmp_path) -> None:
    with pytest.raises(SceneError, match=r"nowhere\.json: no ground truth to read"):
        load_truth(tmp_path / "nowhere.json")
    (tmp_path / "half.json").write_text('{"room": [[0')
    with pytest.raises(SceneError, match=r"half\.json: not valid JSON"):
        load_truth(tmp_path / "half.json")
    with pytest.raises(SceneError, match="lower corner"):
        save_truth(tmp_path / "new.json", make_scene("home_1").static, ROOM[::-1])
    assert not (tmp_path / "new.json").exists()
