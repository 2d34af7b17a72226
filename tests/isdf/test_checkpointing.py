"""A run that is killed, stopped or out of luck leaves a map that loads, and goes on from it."""

from __future__ import annotations

import datetime
import itertools
import json
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from isdf import CheckpointError, IsdfConfig, load_map, mapfile
from isdf.checkpointing import Checkpointer, Stopped, take_up
from isdf.cli import main
from isdf.datasets import RecordedSequence, SequenceWriter
from isdf.runner import Begun, RunReport, run_at_rate, run_every_frame
from isdf.viewer import Controls
from isdf.voxel import ExactConfig, ExactMapper
from tests.isdf.rooms import furnished_orbit

ROOT = Path(__file__).parents[2]
EVERY = 1.0


def recorded(folder: Path, frames: int) -> Path:
    orbit = furnished_orbit(12)
    writer = SequenceWriter(folder, orbit[0].camera, fps=10.0)
    for frame in itertools.islice(itertools.cycle(orbit), frames):
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    return folder


def start(*words: object) -> subprocess.Popen:
    command = [sys.executable, "-m", "isdf", "map", *map(str, words)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(path: Path, process: subprocess.Popen, newer_than: float = 0.0) -> None:
    while process.poll() is None and not (path.exists() and path.stat().st_mtime > newer_than):
        time.sleep(0.01)
    assert process.returncode is None, process.communicate()


@pytest.mark.parametrize(
    ("kills", "method"),
    [
        (2, "default"),
        pytest.param(20, "default", marks=pytest.mark.slow),
        pytest.param(15, "isdf", marks=pytest.mark.slow),
        pytest.param(15, "exact", marks=pytest.mark.slow),
    ],
)
def test_kill_9_loses_at_most_the_period_and_never_the_file(kills, method, tmp_path, record_property) -> None:
    """One run, killed again and again and resumed: at random moments, often enough in the middle of saving."""
    sequence, out, chance = recorded(tmp_path / "room", 150 * kills + 400), tmp_path / "run", random.Random(3)
    path, seen, losses, left = out / "map.safetensors", 0, [], 0
    words = (sequence, "--out", out, "--steps-per-frame", 3, "--checkpoint-every", EVERY, "--method", method)
    for kill in range(kills):
        before = path.stat().st_mtime if kill else 0.0
        process = start(*(("--resume", out) if kill else words))
        wait_for(path, process, before)
        time.sleep(chance.uniform(0, 2.5 * EVERY))
        until = time.monotonic() + 2 * EVERY
        while kill % 2 and time.monotonic() < until and not list(out.glob(".map.safetensors.*")):
            time.sleep(0.0005)  # every other kill comes in the middle of saving
        process.kill()
        killed = time.time()
        process.communicate()
        assert process.returncode == -signal.SIGKILL, "the sequence is too short: the run has ended"
        header = mapfile.header(path)
        losses.append(killed - datetime.datetime.fromisoformat(header["created"]).timestamp())
        mapper = load_map(path)
        assert mapper.frames_seen == header["run"]["report"]["frames_used"] > seen
        assert bool(torch.isfinite(mapper.field().distance(torch.rand(50, 3))).all())
        seen = mapper.frames_seen
        left += len([p for p in out.iterdir() if p != path])
        assert len([p for p in out.iterdir() if p != path]) <= 1, "litter of earlier kills stays"
    record_property(
        "losses",
        f"{kills} kills: median loss {np.median(losses):.2f} s, worst {max(losses):.2f} s, {left} during a save",
    )
    # On an idle machine none loses more than the period; a busy one may stop a process for longer than a frame.
    assert np.quantile(losses, 0.9) <= EVERY + (1.0 if kills <= 2 else 0.1) and max(losses) < EVERY + 2.0


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_leaves_a_checkpoint_and_says_how_to_go_on(number, code, tmp_path) -> None:
    sequence, out = recorded(tmp_path / "room", 400), tmp_path / "run"
    process = start(sequence, "--out", out, "--steps-per-frame", 2, "--method", "isdf")
    wait_for(out / "map.safetensors", process)
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == code and f"isdf map --resume {out}" in error
    assert sorted(p.name for p in out.iterdir()) == ["map.safetensors"]
    assert 0 < load_map(out / "map.safetensors").frames_seen < 400


def test_a_resumed_run_ends_as_if_it_had_not_been_stopped(tmp_path, monkeypatch, capsys) -> None:
    sequence, out, report = recorded(tmp_path / "room", 12), tmp_path / "run", RunReport()
    words = (sequence, "--steps-per-frame", 4, "--mesh-spacing", 0.2, "--method", "isdf")
    options = {"sequence_dir": str(sequence), "steps_per_frame": 4, "mesh_spacing": 0.2, "method": "isdf"}
    watch = Checkpointer(out / "map.safetensors", 1e-9, report, options, lambda *_: None)

    def stop(mapper: object, arrived: int) -> None:
        watch(mapper, arrived)
        if arrived == 5:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        run_every_frame(RecordedSequence(sequence), IsdfConfig(), 4, stop, Begun(report))
    for line in (("--resume", out), (*words, "--out", tmp_path / "whole")):
        monkeypatch.setattr("sys.argv", ["isdf", "map", *map(str, line), "--json"])
        main()
        report = json.loads(capsys.readouterr().out)
        assert report["frames_used"] == 12 and report["steps"] == 48
    resumed, whole = (load_map(tmp_path / name / "map.safetensors") for name in ("run", "whole"))
    points = torch.rand(100, 3)
    assert torch.equal(resumed.field().distance(points), whole.field().distance(points))
    with pytest.raises(CheckpointError, match="finished"):
        take_up(out / "map.safetensors")


def test_the_first_result_is_there_soon(tmp_path) -> None:
    """CPU seconds of the whole process, for this machine may be busy."""
    sequence, out = recorded(tmp_path / "room", 400), tmp_path / "run"
    for _ in range(2):  # the first time fills the caches
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        process = start(sequence, "--out", out, "--cpu-per-second", 1.0)
        wait_for(out / "map.safetensors", process)
        process.kill()
        process.communicate()
        (out / "map.safetensors").unlink()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 5.0


@pytest.mark.parametrize("config", [IsdfConfig(), ExactConfig()])
def test_the_live_clock_goes_on_where_it_stood(config, tmp_path) -> None:
    sequence, path, report = RecordedSequence(recorded(tmp_path / "room", 30)), tmp_path / "m", RunReport()
    timer = itertools.count(0.0, 0.01).__next__  # whatever else this machine does

    def interrupt(_: object, arrived: int) -> None:
        if arrived > 12:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Stopped), Checkpointer(path, 1.0, report, {}, interrupt) as watch:
        run_at_rate(sequence, config, 0.3, watch, Begun(report), timer)
    begun, options = take_up(path)
    # Stopped at the call after the signal, if not at that one.
    assert options == {} and 12 < begun.report.frames_arrived <= 20
    spent = begun.report.cpu_seconds + begun.report.waited_seconds
    assert 0.3 * 1.2 <= spent < 0.8
    mapper, whole = run_at_rate(sequence, config, 0.3, lambda *_: None, begun, timer)
    assert whole.frames_used + whole.frames_dropped == 30 and mapper.frames_seen == whole.frames_used
    assert 0.9 <= whole.cpu_seconds + whole.waited_seconds < 1.3


def test_saving_comes_early_enough_for_slow_frames_and_slow_disks(tmp_path, monkeypatch) -> None:
    now, saved = [100.0], []
    monkeypatch.setattr("isdf.checkpointing.time.monotonic", lambda: now[0])

    class Slow(ExactMapper):
        def save(self, *_: object) -> None:
            saved.append(now[0])
            now[0] += 2.0

    watch, mapper = Checkpointer(tmp_path / "m", 10.0, RunReport(), {}, lambda *_: None), Slow()
    mapper.frames_seen = 1
    for _ in range(60):
        now[0] += 3.0
        watch(mapper, 1)
    # A file is complete 2 s after its moment: from then until the next one is complete is the most that is lost.
    assert np.all(np.diff(saved) + 2.0 <= 10.0) and np.diff(saved).min() > 4.0


def test_nothing_is_saved_before_the_first_frame(tmp_path) -> None:
    report = RunReport()
    with Checkpointer(tmp_path / "m", 1.0, report, {}, lambda *_: None) as watch:
        os.kill(os.getpid(), signal.SIGTERM)
        empty = recorded(tmp_path / "room", 3)
        (empty / "depth" / "000000.png").unlink()
        with pytest.raises(Stopped) as stopped:
            run_every_frame(RecordedSequence(empty), IsdfConfig(), 1, watch, Begun(report))
    assert (
        not stopped.value.saved and stopped.value.number == signal.SIGTERM and not (tmp_path / "m").exists()
    )


@pytest.mark.parametrize(
    ("run", "fault"),
    [
        (None, "no run to resume"),
        ({"options": {}, "report": {}}, "incomplete"),
        ({"options": {"sequence_dir": "x", "evil": 1}}, "impossible options"),
        ({"options": {"sequence_dir": "x", "seed": "one"}}, "impossible options"),
        (
            {"options": {"sequence_dir": "SEQUENCE", "method": "isdf", "steps_per_frame": 1, "seed": 7}},
            "began with",
        ),
        ({"report": {"frames_arrived": -4}}, "not finite and positive"),
        ({"report": {"cpu_seconds": "NaN"}}, "not finite and positive"),
    ],
)
def test_a_resume_trusts_no_file(run, fault, tmp_path, monkeypatch, capsys) -> None:
    sequence, report = recorded(tmp_path / "room", 2), RunReport()
    options = {"sequence_dir": str(sequence), "steps_per_frame": 1, "method": "isdf"}
    watch = Checkpointer(tmp_path / "map.safetensors", 1.0, report, options, lambda *_: None)
    run_every_frame(RecordedSequence(sequence), IsdfConfig(), 1, watch, Begun(report))
    path = tmp_path / "map.safetensors"
    header = mapfile.header(path)
    tensors, _ = mapfile.read(path, header["format"], header["version"])
    if run is None:
        header.pop("run")
    else:
        counts = {**header["run"]["report"], **run["report"]} if run.get("report") else run.get("report")
        header["run"] |= run | ({"report": counts} if counts is not None else {})
        text = header["run"]["options"].get("sequence_dir")
        header["run"]["options"] |= {"sequence_dir": str(sequence)} if text == "SEQUENCE" else {}
    mapfile.write(path, tensors, header)
    monkeypatch.setattr("sys.argv", ["isdf", "map", "--resume", str(tmp_path)])
    with pytest.raises(SystemExit) as exit_info:
        main()
    assert exit_info.value.code == 2 and fault in capsys.readouterr().err


def test_a_run_that_is_paused_stops_when_asked_to_and_pauses_count_as_no_slow_frames(tmp_path) -> None:
    controls, mapper, report = Controls(), ExactMapper(ExactConfig()), RunReport()
    mapper.integrate(furnished_orbit(12)[0])
    mapper.refresh()
    path = tmp_path / "map.safetensors"

    def paused(_: object, arrived: int) -> None:
        controls.hold(lambda: not watch.stopping and time.monotonic() < end)

    with Checkpointer(path, 100.0, report, {}, paused) as watch:
        end = time.monotonic() + 0.5
        watch(mapper, 1)
        controls.pause()
        watch(mapper, 2)
        watch(mapper, 3)
        assert watch._gap < 0.3, "half a second of pause is no frame's"
        end = time.monotonic() + 20.0
        threading.Timer(0.2, os.kill, [os.getpid(), signal.SIGTERM]).start()
        began = time.monotonic()
        with pytest.raises(Stopped):
            watch(mapper, 4)
        assert time.monotonic() - began < 5.0
    assert load_map(path).frames_seen == 1
