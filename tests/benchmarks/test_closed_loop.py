"""The closed-loop benchmark: free ways, contacts found anew, disturbances, and results that a second run keeps."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import robots
from benchmarks import navigation_episodes
from benchmarks.episodes import run_missing
from benchmarks.free_floor import FreeFloor
from benchmarks.recheck import recheck
from examples.disturbances import DisturbedRobot, MovedFurniture, People, PoseNoise, SensorFault
from planning.drive import MobileRobot
from robots.simulation import Box, DepthFrame, PinholeCamera, Scene, SimulatedMobileRobot, World
from robots.simulation.poses import planar_pose


def block(name: str, x: float | int, y: float | int, size: tuple[float | int, ...]) -> Box:
    return Box(name, planar_pose(float(x), float(y), size[2] / 2), tuple(map(float, size)))


def hall() -> Scene:
    """6 m x 4 m with walls round it, and one across that leaves a gap at y > 1."""
    walls = [
        block("west", -3.1, 0, (0.2, 4.4, 2.0)),
        block("east", 3.1, 0, (0.2, 4.4, 2.0)),
        block("north", 0, 2.1, (6.4, 0.2, 2.0)),
        block("south", 0, -2.1, (6.4, 0.2, 2.0)),
        block("across", 0, -0.5, (0.2, 3.0, 2.0)),
    ]
    floor = Box("floor", planar_pose(0.0, 0.0, -0.05), (20.0, 20.0, 0.1))
    return Scene("hall", (floor, *walls), size=(6.0, 4.0, 2.0))


@pytest.fixture(scope="module")
def floor() -> FreeFloor:
    return FreeFloor.of(hall(), radius=0.3)


def test_free_places_are_inside_and_keep_their_clearance(floor: FreeFloor) -> None:
    places = floor.places(0.1)
    assert len(places) > 500
    assert (np.abs(places[:, 0]) <= 3 - 0.4 + 0.01).all() and (np.abs(places[:, 1]) <= 2 - 0.4 + 0.01).all()
    beside = places[np.abs(places[:, 1] + 0.5) < 1.4]
    assert (np.abs(beside[:, 0]) >= 0.1 + 0.4 - 0.01).all(), "not in the wall across"


def test_the_shortest_way_goes_through_the_gap(floor: FreeFloor) -> None:
    length = floor.shortest(np.array([-1.5, -1.0]), np.array([1.5, -1.0]))
    # Round the end of the wall across, grown by the radius: about two straight lines to (+-0.4, 1.0).
    around = 2 * np.hypot(1.5 - 0.4, 2.0 + 0.15) + 0.8
    assert 0.95 * around < length < 1.15 * around
    assert floor.shortest(np.array([-1.5, -1.0]), np.array([-1.5, 0.5])) == pytest.approx(1.5, abs=0.11)


def drive_in(world: World, x: float) -> SimulatedMobileRobot:
    model = robots.load("tiago")
    q = model.named["tucked"].double().numpy().copy()
    q[:3] = (x, 0.5, 0.0)
    return SimulatedMobileRobot(world, model, q)


@pytest.mark.parametrize(("x", "touches"), [(-1.2, False), (-2.75, True)])
def test_contacts_are_found_anew_from_the_states(tmp_path: Path, x: float, touches: bool) -> None:
    with World(hall()) as world:
        robot = drive_in(world, -1.2)
        robot.drive(0.0, 0.0, 0.1)
        robot.recording.save(tmp_path / "states.npz")
    with np.load(tmp_path / "states.npz") as saved:
        data = dict(saved)
    data["joint_positions"][-1, 0] = x
    np.savez(tmp_path / "states.npz", **data)
    found = recheck(hall(), tmp_path / "states.npz")
    assert any(pair.endswith("- west") for pair in found) == touches
    assert bool(found) == touches, "the floor is no contact"


def test_what_comes_and_moves_during_an_episode_is_recorded_and_found_anew(tmp_path: Path) -> None:
    free = np.array([[2.0, 0.5], [2.0, 0.6]])
    with World(hall()) as world:
        robot = drive_in(world, -1.2)
        robot.drive(0.0, 0.0, 0.1)
        People(free, 0.1, seed=0, count=1).advance(robot, 0.1)
        old = world.object_pose("west")
        moved = old.copy()
        moved[0, 3] -= 1.0
        world.set_object_pose("west", moved)
        robot.drive(0.0, 0.0, 0.1)
        robot.recording.save(tmp_path / "states.npz")
    with np.load(tmp_path / "states.npz") as saved:
        data = dict(saved)
    assert sorted(data["object_names"]) == ["person_0", "west"]
    person, west = (
        data["object_poses"][:, list(data["object_names"]).index(n)] for n in ("person_0", "west")
    )
    assert np.isnan(person[0]).all() and person[-1, 0, 3] == pytest.approx(2.0, abs=0.1)
    np.testing.assert_allclose(west[[0, -1]], [old, moved], atol=1e-6)
    assert not recheck(hall(), tmp_path / "states.npz")
    data["joint_positions"][-1, :2] = person[-1, :2, 3]
    np.savez(tmp_path / "states.npz", **data)
    assert any(pair.endswith("- person_0") for pair in recheck(hall(), tmp_path / "states.npz"))


def frame(time: float = 0.0) -> DepthFrame:
    camera = PinholeCamera.from_fov(16, 12)
    return DepthFrame(np.ones((12, 16), dtype=np.float32), np.eye(4), camera, time)


def test_pose_noise_has_the_size_it_says() -> None:
    noise = PoseNoise(seed=1, position=0.01, angle=np.radians(0.5))
    poses = np.array([noise.frame(frame()).T_world_camera for _ in range(2000)])
    assert poses[:, :3, 3].std(axis=0) == pytest.approx([0.01] * 3, rel=0.1)
    angles = np.arccos((np.trace(poses[:, :3, :3], axis1=1, axis2=2) - 1).clip(-3, 3) / 2)
    assert np.sqrt((angles**2).mean() / 3) == pytest.approx(np.radians(0.5), rel=0.1)
    assert np.abs(np.einsum("nji,njk->nik", poses[:, :3, :3], poses[:, :3, :3]) - np.eye(3)).max() < 1e-9


def test_sensor_faults_last_as_long_as_they_say() -> None:
    kinds = {kind: SensorFault(kind, 1.0, 2.0) for kind in ("silent", "invalid", "jump")}
    for fault in kinds.values():
        for time in (0.9, 2.0):
            same = frame(time)
            assert fault.frame(same) is same
    assert kinds["silent"].frame(frame(1.0)) is None
    assert not kinds["invalid"].frame(frame(1.5)).depth.any()
    assert np.linalg.norm(kinds["jump"].frame(frame(1.5)).T_world_camera[:3, 3]) == pytest.approx(0.3)


class StandIn:
    """A robot that stands, in a world that remembers where bodies are put."""

    def __init__(self, x: float, y: float) -> None:
        self.at, self.time, self.poses = np.array([x, y, 0.0]), 0.0, {}
        self.world = SimpleNamespace(
            add_body=lambda solid: self.poses.setdefault(solid.name, solid.pose.copy()),
            set_object_pose=lambda name, pose: self.poses.__setitem__(name, pose.copy()),
            object_pose=lambda name: self.poses[name].copy(),
        )

    def base_state(self) -> np.ndarray:
        return self.at


def test_people_walk_in_free_space_and_wait_for_the_robot() -> None:
    grid = np.stack(np.meshgrid(np.arange(-2, 2.05, 0.1), np.arange(-2, 2.05, 0.1)), -1).reshape(-1, 2)
    robot, people = StandIn(0.0, 0.0), People(grid, 0.1, seed=3)
    ways = {name: [] for name in people.names}
    for _ in range(600):
        people.advance(robot, 0.1)
        for name in people.names:
            ways[name].append(robot.poses[name][:2, 3])
    for way in map(np.array, ways.values()):
        steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
        assert steps.max() <= 0.05 + 1e-9 and steps.sum() > 5, "0.5 m/s, and they do walk"
        assert np.abs(way).max() < 2.2
        assert np.linalg.norm(way, axis=1).min() - People.RADIUS > 0.6, "nobody walks into the robot"
    gaps = np.linalg.norm(np.array(ways["person_0"]) - np.array(ways["person_1"]), axis=1)
    assert gaps.min() > 2 * People.RADIUS


def test_people_walk_where_people_fit_and_not_only_where_the_robot_does() -> None:
    to_west = np.array(navigation_episodes.people_places(hall()))[:, 0].min() + 3.0
    alone = People.RADIUS + navigation_episodes.BESIDE_PEOPLE
    assert alone - 0.01 <= to_west <= alone + 0.11 < navigation_episodes.RADIUS + navigation_episodes.ROOM


def test_people_walk_from_place_to_place_through_passages() -> None:
    axis = np.arange(-2, 2.05, 0.1)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    grid = grid[(np.abs(grid[:, 0]) > 0.35) | (np.abs(grid[:, 1]) < 0.15)]  # two rooms and a passage
    robot, people = StandIn(9.0, 9.0), People(grid, 0.1, seed=1, count=1)
    way = []
    for _ in range(3000):
        people.advance(robot, 0.1)
        way.append(robot.poses["person_0"][:2, 3])
    x, y = np.array(way).T
    assert np.abs(y[np.abs(x) < 0.3]).max() < 0.15, "not through the wall"
    assert np.count_nonzero(np.diff(np.sign(x))) > 10, "from room to room"


def test_furniture_is_moved_once_when_it_is_time() -> None:
    robot = StandIn(0.0, 0.0)
    robot.poses["chair"] = planar_pose(1.0, 1.0, 0.4)
    moved = MovedFurniture("chair", np.array([2.0, -1.0]), lambda robot: robot.time >= 1.0)
    moved.advance(robot, 0.1)
    assert moved.moved_at is None and robot.poses["chair"][0, 3] == 1.0
    robot.time = 1.0
    moved.advance(robot, 0.1)
    assert moved.moved_at == 1.0 and robot.poses["chair"][:3, 3].tolist() == [2.0, -1.0, 0.4]
    robot.poses["chair"] = planar_pose(0.0, 0.0)
    moved.advance(robot, 0.1)
    assert robot.poses["chair"][0, 3] == 0.0


def test_a_disturbed_robot_is_a_mobile_robot() -> None:
    with World(hall()) as world:
        quiet = drive_in(world, -1.2)
        robot = DisturbedRobot(quiet, [SensorFault("silent", 0.0, 9.0)])
        assert isinstance(robot, MobileRobot)
        assert robot.observe() is None and quiet.observe() is not None
        assert robot.robot is quiet.robot, "what it has not itself is the undisturbed robot's"
        robot.drive(0.0, 0.1, 0.1)
        assert len(robot.recording) == 1 and robot.time == pytest.approx(0.1, abs=0.01)


def pretend(task: navigation_episodes.NavigationTask) -> dict:
    if task.number == 1:
        raise RuntimeError("the simulator fell over")
    drive = {"status": "reached", "message": "", "slowed": 3, "stopped": 2, "blind": 0}
    touched = {"arm - table": 0.01} if task.number == 2 else {}
    return {
        "success": not touched, "reached": True, "contacts": touched, "contacts_rechecked": {}, "drive": drive,
        "length_ratio": 1.2, "planning_times": [0.1, 0.2],
    }  # fmt: skip


def test_results_are_kept_and_errors_are_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    asked: list[int] = []

    def noted(task: navigation_episodes.NavigationTask) -> dict:
        asked.append(task.number)
        return pretend(task)

    monkeypatch.setattr(navigation_episodes, "episode", noted)
    monkeypatch.setattr(navigation_episodes, "make_scene", lambda name, seed=0: hall())
    options = navigation_episodes.Navigate(out=tmp_path, scene="hall", episodes=3)
    run_missing(options)
    assert logging.root.manager.disable == logging.NOTSET, "other programs in this process still log"
    folders = sorted((tmp_path / "hall" / "default" / "none").iterdir())
    assert asked == [0, 1, 2] and [f.name for f in folders] == ["000", "001", "002"]
    (folders[2] / "report.json").unlink()
    reports = run_missing(options)
    assert asked == [0, 1, 2, 2], "what is there is not run again"
    assert [json.loads((f / "report.json").read_text())["task"]["number"] for f in folders] == [0, 1, 2]
    assert reports[1]["error"] == "RuntimeError: the simulator fell over"
    assert "in pretend" in reports[1]["traceback"]
    text = (tmp_path / "summary.md").read_text()
    assert (
        "| 3 | 2 | 1 | 1.20 |" in text and "episode 1: RuntimeError" in text and "touched arm - table" in text
    )
    for task in navigation_episodes.make_tasks(options):
        assert np.linalg.norm(np.array(task.start[:2]) - task.goal) >= navigation_episodes.APART
        assert task.shortest >= navigation_episodes.APART * 0.99
    capsys.readouterr()


def test_a_scene_without_room_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(navigation_episodes, "APART", 20.0)
    monkeypatch.setattr(navigation_episodes, "make_scene", lambda name, seed=0: hall())
    with pytest.raises(SystemExit, match="hall: only 0 starts and goals 20 m apart"):
        run_missing(navigation_episodes.Navigate(out=tmp_path, scene="hall", episodes=1))
