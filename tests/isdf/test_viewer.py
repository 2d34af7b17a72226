"""The viewer's parts without a browser: mailbox, controls, pictures, recordings, and that nobody waits for it."""

from __future__ import annotations

import json
import sys
import threading
import time

import numpy as np
import pytest
import torch

import isdf
import isdf.cli
from isdf.datasets import SequenceWriter, open_sequence
from isdf.errors import ConfigError, ViewerError
from isdf.field import AnalyticField
from isdf.runner import run_every_frame
from isdf.viewer import Controls, Line, Mailbox, Recorder, Recording, Shape, Spheres, Viewer, ViewState
from isdf.viewer.pictures import depth_picture, slice_picture
from isdf.viewer.replay import Replay
from tests.isdf.rooms import furnished_orbit

UP = np.array([0.0, 0.0, 1.0])


class Ball(AnalyticField):
    """A ball of half a metre about a point; the map is sure of what lies at positive x."""

    def __init__(self, centre: tuple[float, float, float] = (0.4, 0.0, 0.5)) -> None:
        self.centre = torch.tensor(centre)
        self.bounds = torch.tensor([[-1.0, -1.5, 0.0], [1.0, 1.5, 1.0]])

    def distance_and_gradient(self, points):
        away = points - self.centre.to(points)
        far = away.norm(dim=-1)
        return far - 0.5, away / far.clamp(min=1e-9)[..., None]

    def confidence(self, points):
        return (points[..., 0] > 0).to(points)


@pytest.fixture
def viewer():
    with Viewer(0) as opened:
        yield opened


@pytest.fixture
def watched(monkeypatch):
    """As if a browser were connected to every viewer."""
    monkeypatch.setattr(Viewer, "watched", property(lambda self: not self._closing.is_set()))


def until(true, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


def full_state(t: float = 1.0, field=None, shape: Shape | None = None) -> ViewState:
    """A state with something of everything."""
    box = shape or Shape(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32), (1, 2, 3))
    pose = np.eye(4)
    pose[:3, 3] = (t, 2.0, 3.0)
    return ViewState(
        t,
        "on its way",
        furnished_orbit(12)[0],
        field,
        {"robot/arm": box},
        {"robot/arm": pose},
        {"spheres": Spheres(np.full((4, 3), t), np.full(4, 0.1), (9, 8, 7), 0.5)},
        {"plan": Line(np.array([[0.0, 0, 0], [1, 1, t]]), (4, 5, 6), 0.02)},
        np.array([1.5, -0.5]),
    )


def test_a_mailbox_holds_the_newest_letter_only() -> None:
    box: Mailbox[int] = Mailbox()
    assert box.take(0.0) is None
    for number in range(5):
        box.put(number)
    assert box.take(0.0) == 4 and box.take(0.0) is None and box.replaced == 4
    threading.Timer(0.05, box.put, [7]).start()
    assert box.take(5.0) == 7


def test_controls_pause_step_and_play() -> None:
    controls = Controls()
    assert controls.may_go() and not controls.paused
    controls.pause()
    assert controls.paused and not controls.may_go()
    controls.step()
    controls.step()
    assert [controls.may_go() for _ in range(3)] == [True, True, False]
    controls.step()
    controls.play()
    assert controls.may_go() and controls.may_go()
    controls.pause()
    assert not controls.may_go(), "steps of before are forgotten"


def test_holding_ends_with_a_step_or_when_nobody_wants_it_any_more() -> None:
    controls = Controls()
    assert not controls.hold(lambda: True)
    controls.pause()
    threading.Timer(0.1, controls.step).start()
    began = time.monotonic()
    assert controls.hold(lambda: True) and 0.08 < time.monotonic() - began < 3.0
    end = time.monotonic() + 0.1
    assert controls.hold(lambda: time.monotonic() < end) and controls.paused


def test_a_goal_is_taken_once_and_is_the_last_one_asked_for() -> None:
    controls = Controls()
    assert controls.take_goal() is None
    controls.move_goal(np.array([1.0, 2.0]))
    controls.move_goal(np.array([3.0, 4.0]))
    assert controls.take_goal().tolist() == [3.0, 4.0] and controls.take_goal() is None


@pytest.mark.parametrize("up", [UP, np.array([0.0, -1.0, 0.0])])
def test_a_slice_has_its_zero_contour_where_the_surface_is(up) -> None:
    ball = Ball((0.4, 0.3, 0.5) if up[2] else (0.4, -0.5, 0.3))
    if not up[2]:
        ball.bounds = torch.tensor([[-1.0, -1.0, -1.5], [1.0, 0.0, 1.5]])
    shown = slice_picture(ball, 0.5, up, fade=False)
    height, width = shown.image.shape[:2]
    right, back, normal = shown.axes
    assert np.allclose(normal, up) and np.allclose(np.cross(right, back), normal)
    rows, columns = np.nonzero((shown.image[..., :3] == 0).all(axis=-1))
    across = ((columns + 0.5) / width - 0.5) * shown.size[0]
    along = (0.5 - (rows + 0.5) / height) * shown.size[1]
    points = shown.centre + across[:, None] * right + along[:, None] * back
    assert len(points) > 50
    distance = ball.distance(torch.from_numpy(points))
    assert distance.abs().max() < 1.5 * shown.size[0] / width
    nearest = ball.centre.numpy() - shown.centre
    row = int(height * (0.5 - nearest @ back / shown.size[1]))
    middle = shown.image[row, int(width * (0.5 + nearest @ right / shown.size[0]))]
    assert middle[0] > middle[2], "red inside"
    assert shown.image[2, 2][2] > shown.image[2, 2][0], "blue outside"


def test_a_slice_fades_where_the_map_is_unsure_and_can_show_how_sure_it_is() -> None:
    opacity = slice_picture(Ball(), 0.5, UP).image[..., 3]
    assert opacity[:, 5].max() < 0.5 * opacity[:, -5].min()
    sure = slice_picture(Ball(), 0.5, UP, "confidence", fade=False).image
    assert (sure[0, 5, :3] != sure[0, -5, :3]).any() and len(
        np.unique(sure[..., :3].reshape(-1, 3), axis=0)
    ) == 2
    assert (sure[..., 3] == sure[0, 0, 3]).all()


def test_a_depth_picture_is_black_where_nothing_was_measured_and_brighter_nearby() -> None:
    picture = depth_picture(torch.tensor([[0.0, 0.5, 4.0]])).astype(int).sum(axis=-1)[0]
    assert picture[0] == 0 and picture[1] > picture[2] > 0


def test_a_recording_comes_back_as_it_was(tmp_path) -> None:
    ball, box = Ball(), full_state().shapes["robot/arm"]
    recorder = Recorder(tmp_path, (0.0, 0.0, 1.0), field_period=1.0)
    times = [0.0, 0.5, 1.2, 2.5]
    for t in times:
        recorder.add(lambda t=t: full_state(t, ball if t < 2 else Ball((0.0, 0.0, 0.5)), box))
    recorder.close()
    recording = Recording(tmp_path)
    assert recording.times == times and recording.up == (0.0, 0.0, 1.0)
    assert len(list(tmp_path.glob("shape_*"))) == 1 and len(list(tmp_path.glob("field_*"))) == 2, (
        "written once"
    )
    for number, t in enumerate(times):
        was, state = full_state(t, shape=box), recording.state(number)
        assert (state.time, state.status) == (t, was.status)
        assert np.array_equal(state.poses["robot/arm"], was.poses["robot/arm"])
        assert np.array_equal(state.shapes["robot/arm"].vertices, box.vertices)
        assert state.shapes["robot/arm"].colour == box.colour
        assert np.allclose(state.spheres["spheres"].centres, t) and state.spheres["spheres"].opacity == 0.5
        assert np.allclose(state.lines["plan"].points, was.lines["plan"].points)
        assert np.array_equal(state.goal, was.goal)
        assert np.abs(state.frame.depth - was.frame.depth.numpy()).max() < 0.001
        assert np.allclose(state.frame.T_world_camera, was.frame.T_world_camera)
        assert state.frame.camera.fx == was.frame.camera.fx
    assert recording.state(0).field is recording.state(1).field, "an unchanged map is the same object"
    points = torch.rand(500, 3) * torch.tensor([2.0, 3.0, 1.0]) - torch.tensor([1.0, 1.5, 0.0])
    field = recording.state(1).field
    assert (field.distance(points) - ball.distance(points)).abs().max() < 0.01
    far = points[points[:, 0].abs() > 0.1]
    assert torch.equal(field.confidence(far).round(), ball.confidence(far))
    assert (recording.state(3).field.distance(points) - field.distance(points)).abs().max() > 0.1


def test_a_recording_that_was_cut_off_is_read_and_a_damaged_one_refused(tmp_path) -> None:
    with pytest.raises(ViewerError, match="no recording there"):
        Recording(tmp_path)
    recorder = Recorder(tmp_path)
    recorder.add(lambda: full_state(0.0))
    recorder.add(lambda: 1 / 0)  # what cannot be composed is left out
    recorder.add(lambda: full_state(1.0))
    until(lambda: len(list(tmp_path.glob("state_*"))) == 2)
    assert Recording(tmp_path).times == [0.0, 1.0], "not closed, as of a killed run"
    recorder.close()
    last = sorted(tmp_path.glob("state_*"))[-1]
    last.write_bytes(last.read_bytes()[:200])
    with pytest.raises(ViewerError, match="unreadable"):
        Recording(tmp_path)
    (tmp_path / "recording.json").write_text('{"format": "isdf-recording", "version": 99}')
    with pytest.raises(ViewerError, match="version 99"):
        Recording(tmp_path)


def test_a_new_recording_replaces_the_old_one_and_one_that_is_too_fast_leaves_states_out(
    tmp_path, monkeypatch
) -> None:
    first = Recorder(tmp_path)
    first.add(lambda: full_state(5.0))
    first.close()
    monkeypatch.setattr("isdf.viewer.recording.WAITING", 2)
    release = threading.Event()
    second = Recorder(tmp_path)

    def slow() -> ViewState:
        release.wait(10.0)
        return full_state(6.0)

    began = time.monotonic()
    for _ in range(10):
        second.add(slow)
    assert time.monotonic() - began < 2.0, "who records does not wait"
    release.set()
    second.close()
    assert set(Recording(tmp_path).times) == {6.0} and second.left_out >= 7


def test_a_loop_does_not_wait_for_a_viewer_that_hangs(viewer, watched, monkeypatch) -> None:
    hangs, drawn = threading.Event(), []

    def draw(state: ViewState) -> None:
        drawn.append(state.time)
        hangs.wait(20.0)

    monkeypatch.setattr(viewer.stage, "draw", draw)
    viewer.show(lambda: ViewState(0.0))
    until(lambda: drawn == [0.0])
    began = time.monotonic()
    for t in range(1, 1001):
        viewer.show(lambda t=t: ViewState(float(t)))
        assert viewer.controls.may_go() and viewer.controls.take_goal() is None
    assert time.monotonic() - began < 2.0
    hangs.set()
    until(lambda: len(drawn) == 2)
    assert drawn == [0.0, 1000.0], "only the newest was drawn"


def test_a_picture_that_fails_does_not_end_the_next(viewer, watched) -> None:
    viewer.show(lambda: 1 / 0)
    until(lambda: viewer._mailbox._letter is None)
    viewer.show(lambda: full_state(3.0, Ball()))
    until(lambda: viewer.stage.slice is not None)
    assert "t = 3.0 s" in viewer.panel.status.content


def test_moving_the_slider_moves_the_slice_and_boxes_hide_layers(viewer, watched) -> None:
    viewer.show(lambda: full_state(1.0, Ball()))
    until(lambda: viewer.stage.slice is not None)
    first, picture = viewer.stage.slice, viewer.stage._handles["slice"]
    assert first.centre[2] == 0.5 and (viewer.panel.slider.min, viewer.panel.slider.max) == (0.0, 1.0)
    viewer.panel.slider.value = 0.96
    until(lambda: viewer.stage.slice is not first)
    second = viewer.stage.slice
    assert second.centre[2] == pytest.approx(0.96) and (second.image != first.image).any()
    assert picture.position[2] == pytest.approx(0.96)
    viewer.stage.set_visible("slice", False)
    viewer.stage.set_visible("robot", False)
    assert not picture.visible and not viewer.stage._handles["shapes/robot/arm"].visible
    assert viewer.stage._handles["spheres/spheres"].visible


def test_a_state_replaces_the_last_one(viewer) -> None:
    viewer.stage.draw(full_state(1.0))
    handles = dict(viewer.stage._handles)
    assert set(handles) == {"shapes/robot/arm", "spheres/spheres", "lines/plan", "camera", "goal"}
    viewer.stage.draw(full_state(2.0, shape=full_state().shapes["robot/arm"]))
    assert viewer.stage._handles["shapes/robot/arm"].position.tolist() == [2.0, 2.0, 3.0]
    assert viewer.stage._handles["spheres/spheres"] is handles["spheres/spheres"]
    assert np.allclose(handles["spheres/spheres"].batched_positions, 2.0)
    viewer.stage.draw(ViewState())
    assert set(viewer.stage._handles) == {"camera", "goal"}


def test_the_viewers_own_cpu_time_is_known_apart(viewer, watched) -> None:
    def busy() -> ViewState:
        end = time.thread_time() + 0.3
        while time.thread_time() < end:
            pass
        return ViewState(1.0)

    viewer.show(busy)
    until(lambda: viewer.cpu_seconds() > 0.25)
    before = viewer.cpu_seconds()
    end = time.thread_time() + 0.2
    while time.thread_time() < end:
        pass
    assert viewer.cpu_seconds() - before < 0.1


def test_a_runs_timer_says_what_its_mapping_costs(tmp_path) -> None:
    frames = furnished_orbit(12)
    writer = SequenceWriter(tmp_path, frames[0].camera, fps=10.0)
    for frame in frames[:3]:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    _, report = run_every_frame(
        open_sequence(tmp_path), isdf.MapperConfig(), 1, lambda *_: None, timer=iter(range(1000)).__next__
    )
    assert report.cpu_seconds == int(report.cpu_seconds) and report.cpu_seconds >= 3


def test_a_replay_plays_at_its_pace_pauses_steps_and_jumps(tmp_path, viewer, watched) -> None:
    recorder = Recorder(tmp_path)
    for t in np.arange(0.0, 1.0, 0.1):
        recorder.add(lambda t=t: full_state(float(t), Ball()))
    recorder.close()
    replay = Replay(Recording(tmp_path), viewer)
    began = time.monotonic()
    replay.run(lambda: replay.number == 5)
    assert time.monotonic() - began >= 0.45
    viewer.controls.pause()
    stop = time.monotonic() + 0.3
    replay.run(lambda: time.monotonic() > stop)
    assert replay.number == 5
    viewer.controls.step()
    stop = time.monotonic() + 0.3
    replay.run(lambda: time.monotonic() > stop)
    assert replay.number == 6 and viewer.panel.moment.value == 6
    replay._go_to(2)
    until(lambda: "t = 0.2 s" in viewer.panel.status.content)
    viewer.controls.play()
    replay.run(lambda: replay.number == 9)


def test_without_viser_it_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ViewerError, match=r"pip install 'isdf-planning\[viewer\]'"):
        Viewer(0)


def command(monkeypatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["isdf", *words])
    try:
        isdf.cli.main()
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def test_mapping_with_viewer_and_recording_leaves_the_same_map(tmp_path, monkeypatch, capsys) -> None:
    frames = furnished_orbit(12)
    writer = SequenceWriter(tmp_path / "room", frames[0].camera, fps=10.0)
    for frame in frames:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    plain = ("map", str(tmp_path / "room"), "--steps-per-frame", "1", "--json", "--out")
    assert command(monkeypatch, *plain, str(tmp_path / "a")) == 0
    alone = json.loads(capsys.readouterr().out)
    options = ("--viewer", "--viewer-port", "0", "--record", str(tmp_path / "film"))
    assert command(monkeypatch, *plain, str(tmp_path / "b"), *options) == 0
    said = capsys.readouterr()
    seen = json.loads(said.out)
    assert "http://localhost:" in said.err
    assert seen["mesh_faces"] == alone["mesh_faces"] and seen["frames_used"] == 12
    recording = Recording(tmp_path / "film")
    last = recording.state(len(recording) - 1)
    assert recording.times[-1] >= 1.0 and last.field is not None and "frame 1" in last.status
    points = frames[0].thinned(4, 4.0)
    assert last.field.distance(points).abs().median() < 0.04, "the surface is where it was seen"
    assert len(last.lines["camera path"].points) >= 10
    for path, kind in ((tmp_path / "film", "recording"), (tmp_path / "b", "map")):
        assert command(monkeypatch, "view", str(path), "--port", "0", "--seconds", "0.2", "--json") == 0
        assert json.loads(capsys.readouterr().out)["kind"].startswith(kind)
    assert command(monkeypatch, "view", str(tmp_path / "nowhere")) == 2
    assert "neither a recording" in capsys.readouterr().err


def test_a_run_is_resumed_with_a_viewer_of_its_own(tmp_path, monkeypatch) -> None:
    with pytest.raises(ConfigError, match="leave all other options"):
        isdf.cli.Map(resume=tmp_path, seed=3, viewer=True).run()
    given = isdf.cli.Map(
        sequence_dir=tmp_path, out=tmp_path, viewer=True, viewer_port=1, record=tmp_path, seed=3
    )
    assert set(given._options()) == {"sequence_dir", "seed"}, "how it was watched is no part of a run"
