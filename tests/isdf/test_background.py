"""Mapping in the background: whole snapshots at high rates, a queue that keeps the newest, errors that surface."""

from __future__ import annotations

import threading
import time

import pytest
import torch

from isdf import (
    BackgroundError,
    BackgroundMapper,
    ConfigError,
    DepthFrame,
    FrameError,
    IsdfConfig,
    IsdfMapper,
    Mapper,
    MapperConfig,
    NotReadyError,
    load_map,
)
from isdf.voxel import ExactConfig, ExactMapper
from tests.isdf.rooms import furnished_orbit

PROBES = torch.rand(64, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1 + torch.tensor([0.0, 0, 1])


def witnessed(base: type):
    """A mapper that notes what each field it hands out says at the probes, at the moment it is made."""

    class Witnessed(base):
        notes: dict[int, torch.Tensor]

        def field(self):
            field = super().field()
            self.notes.setdefault(id(field), field.distance(PROBES))
            self.kept.append(field)  # an id must not be used twice
            return field

    return Witnessed


def mapper_of(method: str):
    if method == "exact":
        mapper = witnessed(ExactMapper)(ExactConfig(rebuild_period=0.05))
    elif method == "default":
        mapper = witnessed(Mapper)(MapperConfig())
    else:
        mapper = witnessed(IsdfMapper)(IsdfConfig(first_frame_steps=1, steps_per_frame=1, keyframe_steps=0))
    mapper.notes, mapper.kept = {}, []
    return mapper


@pytest.mark.parametrize("method", ["default", "isdf", "exact"])
def test_snapshots_are_whole_under_load(method) -> None:
    """Four planners at 1 kHz (as far as the machine goes) against a mapper that never rests."""
    mapper, stop = mapper_of(method), threading.Event()
    answers: list[list] = [[] for _ in range(4)]

    def plan(own: list) -> None:
        while not stop.is_set():
            snapshot, due = background.snapshot(), time.monotonic() + 0.001
            own.append((snapshot, snapshot.field.distance(PROBES)))
            time.sleep(max(0.0, due - time.monotonic()))

    with BackgroundMapper(mapper, queue_size=4, publish_every=0.0) as background:
        background.integrate(furnished_orbit(12)[0])
        assert background.flush(30.0)
        threads = [threading.Thread(target=plan, args=(own,)) for own in answers]
        for thread in threads:
            thread.start()
        for frame in furnished_orbit(12)[1:]:
            background.integrate(frame)
            time.sleep(0.1)
        assert background.flush(60.0)
        stop.set()
        for thread in threads:
            thread.join()
        rates = background.rates()
    assert rates.received == 12 and rates.used + rates.dropped == 12 and rates.snapshots > 3
    for own in answers:
        assert len(own) > 100
        numbers = [snapshot.number for snapshot, _ in own]
        assert numbers == sorted(numbers) and len(set(numbers)) > 1
        for snapshot, distance in own:
            assert torch.equal(distance, mapper.notes[id(snapshot.field)])
            assert torch.equal(snapshot.field.distance(PROBES), distance), "a snapshot has changed"
            assert snapshot.frames >= 1 and snapshot.bounds.shape == (2, 3)


class Slow(ExactMapper):
    """Waits for a gate before every frame."""

    def __init__(self) -> None:
        super().__init__(ExactConfig(rebuild_period=0.0))
        self.gate, self.times = threading.Semaphore(0), []

    def integrate(self, frame) -> None:
        self.gate.acquire()
        self.times.append(frame.time)
        super().integrate(frame)


def test_a_full_queue_drops_the_oldest() -> None:
    slow = Slow()
    with BackgroundMapper(slow, queue_size=2) as background:
        frames = furnished_orbit(12)
        assert background.integrate(frames[0])
        while background._frames:  # until the worker holds the first
            time.sleep(0.001)
        kept = [background.integrate(frame) for frame in frames[1:6]]
        assert kept == [True, True, False, False, False] and not background.flush(0.05)
        slow.gate.release(20)
        assert background.flush(30.0)
        rates, snapshot = background.rates(), background.snapshot()
    assert slow.times == [frames[i].time for i in (0, 4, 5)]
    assert (rates.received, rates.used, rates.dropped, rates.refused) == (6, 3, 3, 0)
    assert snapshot.frames == 3 and snapshot.frame_time == frames[5].time


def test_a_flush_brings_a_voxel_map_up_to_date() -> None:
    frames = furnished_orbit(12)
    with BackgroundMapper(ExactMapper(ExactConfig(rebuild_period=100.0)), queue_size=20) as background:
        for frame in frames:
            background.integrate(frame)
        assert background.flush(60.0) and background.snapshot().frames == 12
        field = background.field()
    direct = ExactMapper(ExactConfig(rebuild_period=100.0))
    for frame in frames:
        direct.integrate(frame)
    assert background.field() is field
    direct.refresh()
    assert torch.equal(field.distance(PROBES), direct.field().distance(PROBES))


def test_closing_drains_and_an_error_of_the_caller_does_not_wait_for_that() -> None:
    slow = Slow()
    slow.gate.release(20)
    with BackgroundMapper(slow, queue_size=20) as background:
        for frame in furnished_orbit(12):
            background.integrate(frame)
    assert slow.frames_seen == background.snapshot().frames == 12 and not background._worker.is_alive()
    background.close()
    for call in (lambda: background.integrate(frame), background.flush, lambda: background.save("x")):
        with pytest.raises(BackgroundError, match="closed"):
            call()
    slow = Slow()
    slow.gate.release(20)
    with pytest.raises(ZeroDivisionError), BackgroundMapper(slow, queue_size=20) as background:
        for frame in furnished_orbit(12):
            background.integrate(frame)
        raise ZeroDivisionError
    assert slow.frames_seen < 12 and background.rates().dropped == 12 - slow.frames_seen


class Broken(ExactMapper):
    def integrate(self, frame) -> None:
        if self.frames_seen == 2:
            raise MemoryError("no more")
        super().integrate(frame)


def test_an_error_of_the_worker_surfaces_everywhere() -> None:
    background = BackgroundMapper(Broken(), queue_size=20)
    with pytest.raises(NotReadyError):
        background.field()
    for frame in furnished_orbit(12)[:3]:
        background.integrate(frame)
    background._worker.join(30.0)
    calls = (background.snapshot, background.flush, background.field, background.close)
    for call in (*calls, lambda: background.integrate(frame), lambda: background.save("never")):
        with pytest.raises(BackgroundError, match="MemoryError: no more") as raised:
            call()
        assert isinstance(raised.value.__cause__, MemoryError)
    with pytest.raises(BackgroundError), BackgroundMapper(Broken(), queue_size=20) as background:
        for frame in furnished_orbit(12)[:3]:
            background.integrate(frame)


def test_bad_frames_are_refused_to_the_caller_or_counted(tmp_path) -> None:
    good = furnished_orbit(12)[0]
    far = DepthFrame(good.depth * 0 + 20.0, good.T_world_camera, good.camera, 9.0)  # beyond max_depth
    with BackgroundMapper(ExactMapper()) as background:
        with pytest.raises(FrameError):
            background.integrate(object())
        with pytest.raises(NotReadyError):
            background.save(tmp_path / "none")
        background.integrate(far)
        background.integrate(good)
        assert background.flush(30.0)
        background.save(tmp_path / "map")
        assert background.rates().refused == 1 and background.rates().used == 1
        assert background.snapshot().frame_time == good.time
    assert torch.equal(
        load_map(tmp_path / "map").field().distance(PROBES), background.field().distance(PROBES)
    )
    with pytest.raises(ConfigError):
        BackgroundMapper(ExactMapper(), queue_size=0)


def test_training_goes_on_while_no_frame_waits() -> None:
    with BackgroundMapper(IsdfMapper(), publish_every=0.01) as background:
        background.integrate(furnished_orbit(12)[0])
        background.flush(60.0)
        first = background.snapshot()
        deadline = time.monotonic() + 60
        while background.snapshot().steps < first.steps + 5 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert background.snapshot().number > first.number and background.rates().steps >= first.steps + 5
