from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage

from robots.errors import SceneError
from robots.simulation import Scene, SceneField, Sphere, available_scenes, load_urdf_scene, make_scene
from robots.simulation.free_space import floor_map

SCENES = [(name, seed) for name in ("apartment", "office") for seed in range(10)]
SCENES += [(name, seed) for name in ("flat", "home_1", "home_2", "home_3") for seed in range(3)]


def _column_clearance(field: SceneField, places: np.ndarray) -> np.ndarray:
    """Distance of vertical columns over the floor to the nearest solid, by sampling their heights."""
    z = np.arange(0.01, 1.5, 0.01)
    columns = np.stack([np.column_stack((np.tile(place, (len(z), 1)), z)) for place in places])
    return field.distance(torch.tensor(columns)).amin(dim=-1).numpy()


def _solids(scene: Scene) -> tuple:
    return (*scene.static, *scene.objects)


@pytest.mark.parametrize(("name", "seed"), SCENES)
def test_start_and_goals_are_free_far_apart_and_joined(name, seed):
    scene = make_scene(name, seed)
    field = SceneField(scene).without(["floor"])
    places = np.array([scene.start[:2], *(goal[:2] for goal in scene.goals)])
    assert _column_clearance(field, places).min() >= 0.5
    assert np.linalg.norm(places[1:] - places[0], axis=1).min() >= 3.5
    floor = floor_map(_solids(scene), *scene.size[:2], resolution=0.1)
    at = [(np.abs(floor.x - x).argmin(), np.abs(floor.y - y).argmin()) for x, y in places]
    # On a coarser grid a cell of a disc that only just fits can fall out: ask for a slimmer disc.
    regions = floor.regions(0.4)
    labels = {int(regions[cell]) for cell in at}
    assert len(labels) == 1 and 0 not in labels
    # The base can park at the grasp table, its front over the edge of nothing but air.
    park = np.array([scene.grasp.park[:2]])
    assert _column_clearance(field, park)[0] >= 0.45


@pytest.mark.parametrize("name", ["apartment", "office"])
@pytest.mark.parametrize("seed", [0, 3, 7])
def test_there_is_more_than_one_way_through_the_room(name, seed):
    scene = make_scene(name, seed)
    floor = floor_map(_solids(scene), *scene.size[:2])
    for radius, islands in ((0.35, 2), (0.45, 2 if name == "office" else 1)):
        # An island is a blocked set of cells that does not touch the border: one can pass on either side.
        blocked, count = ndimage.label(~np.pad(floor.regions(radius) > 0, 1))
        assert count - 1 >= islands and blocked[0, 0] == 1


@pytest.mark.parametrize("name", available_scenes())
def test_objects_rest_on_something_and_touch_nothing_else(name):
    scene = make_scene(name, 1)
    for thing in scene.objects:
        surface = torch.tensor(thing.mesh().sample(500, seed=0))
        rest = SceneField(scene).without([thing.name])
        assert rest.distance(surface).min() > -1e-6
        below = rest.distance(torch.tensor(thing.pose[:3, 3]) + torch.tensor([0.0, 0.0, -0.5]))
        bottom = torch.tensor([*thing.pose[:2, 3], thing.mesh().bounds[0, 2]])
        assert abs(float(rest.distance(bottom))) < 1e-6, (thing.name, float(below))


@pytest.mark.parametrize("name", available_scenes())
def test_furniture_stays_in_the_room_and_does_not_run_into_other_furniture(name):
    scene = make_scene(name, 2)
    shell = {s.name for s in scene.static if s.name.startswith(("floor", "wall", "ceiling"))}
    low, high = -np.array(scene.size) / 2, np.array(scene.size) / 2
    for solid in scene.static:
        if solid.name in shell:
            continue
        bounds = solid.mesh().bounds
        assert (bounds[0, :2] > low[:2] - 1e-6).all() and (bounds[1, :2] < high[:2] + 1e-6).all(), solid.name
        assert bounds[0, 2] > -1e-6 and bounds[1, 2] < scene.size[2] + 1e-6, solid.name
        piece = solid.name.split(".")[0]
        mine = [s.name for s in _solids(scene) if s.name.split(".")[0] == piece or _stands_on(s.name)]
        others = SceneField(scene).without(mine)
        assert others.distance(torch.tensor(solid.mesh().sample(300, seed=0))).min() > -1e-6, solid.name


def _stands_on(name: str) -> bool:
    """Parts put onto or into another piece."""
    return "books" in name or name.startswith(("monitor", "printer", "shelf", "bookcase"))


@pytest.mark.parametrize("name", available_scenes())
def test_the_grasp_object_is_within_reach_of_the_parked_base(name):
    for seed in range(4):
        scene = make_scene(name, seed)
        (thing,) = [o for o in scene.objects if o.name == scene.grasp.object_name]
        x, y, yaw = scene.grasp.park
        ahead = thing.pose[:2, 3] - (x, y)
        assert 0.5 < np.linalg.norm(ahead) < 0.8
        assert (
            np.arctan2(ahead[1], ahead[0]) == pytest.approx(yaw, abs=0.05)
            or np.cos(np.arctan2(ahead[1], ahead[0]) - yaw) > 0.99
        )
        assert thing.mass == pytest.approx(0.2) and thing.friction >= 0.8
        assert thing.mesh().bounds[0, 2] == pytest.approx(0.7)


def test_a_seed_is_reproducible_and_another_one_differs():
    a, b, c = make_scene("office", 4), make_scene("office", 4), make_scene("office", 5)
    assert a.start == b.start and a.goals == b.goals and a.grasp == b.grasp
    assert all(np.array_equal(p.pose, q.pose) for p, q in zip(_solids(a), _solids(b), strict=True))
    assert a.start != c.start
    assert any(not np.array_equal(p.pose, q.pose) for p, q in zip(_solids(a), _solids(c), strict=True))


def test_errors_name_the_choices():
    with pytest.raises(SceneError, match=r"'ofice'.*apartment, office, flat"):
        make_scene("ofice")
    with pytest.raises(SceneError, match="no URDF at"):
        load_urdf_scene("nowhere.urdf")
    ball = Sphere("ball", np.eye(4), 0.1)
    with pytest.raises(SceneError, match=r"unique.*ball"):
        Scene("twice", (ball, ball))
    with pytest.raises(SceneError, match=r"positive mass.*ball"):
        Scene("massless", (), (ball,))
