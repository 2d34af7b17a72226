"""Recorded sequences on disk, the two clocks, and the command line on them."""

import json
import math
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from isdf import ConfigError, DatasetError, IsdfConfig, IsdfMapper
from isdf.cli import main
from isdf.datasets import RecordedSequence, SequenceWriter
from isdf.runner import run_at_rate, run_at_steps, run_every_frame
from isdf.slices import estimate_up, slice_basis
from tests.isdf.rooms import furnished_orbit, look_at

# A PNG whose header has no room for what it must say.
SHORT_HEADER = b"\x89PNG\r\n\x1a\n" + (12).to_bytes(4, "big") + b"IHDR" + bytes(16)


@pytest.fixture
def sequence_dir(tmp_path) -> Path:
    frames = furnished_orbit(12)
    writer = SequenceWriter(tmp_path / "room", frames[0].camera, fps=10.0)
    for frame in frames:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    return tmp_path / "room"


def run_cli(monkeypatch, *words: object) -> None:
    monkeypatch.setattr("sys.argv", ["isdf", *map(str, words)])
    main()


def test_a_written_sequence_reads_back(sequence_dir) -> None:
    sequence = RecordedSequence(sequence_dir)
    assert len(sequence) == 12 and sequence.fps == 10.0
    for frame, original in zip(sequence, furnished_orbit(12), strict=True):
        torch.testing.assert_close(frame.depth, original.depth, atol=2e-4, rtol=0)
        torch.testing.assert_close(frame.T_world_camera, original.T_world_camera)
        assert frame.time == pytest.approx(original.time)


def test_writing_keeps_bad_pixels_invalid_and_never_overwrites(tmp_path, sequence_dir) -> None:
    camera = furnished_orbit(12)[0].camera
    writer = SequenceWriter(tmp_path / "bad", camera)
    depth = np.full((camera.height, camera.width), 2.0)
    depth[0, :5] = [np.nan, np.inf, -1.0, 99.0, 0.0]
    writer.write(depth, np.eye(4))
    read = RecordedSequence(tmp_path / "bad")[0].depth
    assert read[0, :5].tolist() == [0.0] * 5 and float(read[1, 1]) == 2.0
    with pytest.raises(DatasetError, match="already holds a sequence"):
        SequenceWriter(sequence_dir, camera)


def test_listed_invalid_values_are_ignored(sequence_dir) -> None:
    path = sequence_dir / "depth" / "000000.png"
    values = np.array(Image.open(path))
    values[3, 3] = 65535
    Image.fromarray(values).save(path)
    for key in ("invalid", "invalid_values"):
        intrinsics = json.loads((sequence_dir / "intrinsics.json").read_text()) | {key: [0, 65535]}
        (sequence_dir / "intrinsics.json").write_text(json.dumps(intrinsics))
        assert RecordedSequence(sequence_dir)[0].depth[3, 3] == 0


def test_broken_sequences_name_the_file_and_the_fault(sequence_dir) -> None:
    with pytest.raises(DatasetError, match=r"depth, poses\.txt, intrinsics\.json missing"):
        RecordedSequence(sequence_dir / "depth")
    (sequence_dir / "depth" / "000004.png").write_bytes(b"not an image")
    (sequence_dir / "depth" / "000003.png").write_bytes(SHORT_HEADER)
    (sequence_dir / "depth" / "000005.png").unlink()
    Image.new("RGB", (80, 60)).save(sequence_dir / "depth" / "000006.png")
    sequence = RecordedSequence(sequence_dir)
    for index, fault in (
        (3, "not a readable image"),
        (4, "not a readable image"),
        (5, "missing"),
        (6, "one channel"),
    ):
        with pytest.raises(DatasetError, match=f"{index:06d}.*{fault}"):
            sequence[index]
    intrinsics = sequence_dir / "intrinsics.json"
    good = intrinsics.read_text()
    for text, fault in (
        ("{", "not valid JSON"),
        ("{}", "missing"),
        (good.replace("5000.0", "0"), "depth_scale"),
        (good.replace('"width": 80', '"width": Infinity'), "infinity"),
        (good.replace('"width": 80', '"width": 80, "cx": 1' + "0" * 400), "too large"),
    ):
        intrinsics.write_text(text)
        with pytest.raises(DatasetError, match=rf"intrinsics\.json: .*{fault}"):
            RecordedSequence(sequence_dir)
    intrinsics.write_text(good)
    for text, fault in (
        ("0 1 2 3\n", "16 numbers"),
        ("0 " + "x " * 16, "could not convert"),
        ("# none\n", "no poses"),
    ):
        (sequence_dir / "poses.txt").write_text(text)
        with pytest.raises(DatasetError, match=f"poses.txt.*{fault}"):
            RecordedSequence(sequence_dir)


def test_unusable_frames_are_passed_over_and_reported(sequence_dir) -> None:
    for index in (0, 3):
        Image.fromarray(np.zeros((60, 80), np.uint16)).save(sequence_dir / "depth" / f"{index:06d}.png")
    lines = (sequence_dir / "poses.txt").read_text().splitlines()
    lines[6] = " ".join(["5", *["nan"] * 16])
    (sequence_dir / "poses.txt").write_text("\n".join(lines))
    mapper, report = run_every_frame(RecordedSequence(sequence_dir), IsdfConfig(), 1, lambda *_: None)
    assert sorted(report.frames_refused) == [0, 3, 5] and report.frames_used == 9 and mapper.frames_seen == 9
    assert "no valid pixel" in report.frames_refused[0] and "NaN" in report.frames_refused[5]


def test_a_sequence_without_any_usable_frame_is_an_error(sequence_dir) -> None:
    for index in range(12):
        Image.fromarray(np.zeros((60, 80), np.uint16)).save(sequence_dir / "depth" / f"{index:06d}.png")
    for run, clock in ((run_every_frame, 1), (run_at_rate, 0.05), (run_at_steps, 30.0)):
        with pytest.raises(DatasetError, match="none of the 12 frames"):
            run(RecordedSequence(sequence_dir), IsdfConfig(), clock, lambda *_: None)


def test_every_frame_gets_its_steps(sequence_dir) -> None:
    mapper, report = run_every_frame(RecordedSequence(sequence_dir), IsdfConfig(), 2, lambda *_: None)
    assert mapper.steps == report.steps == 24 and report.frames_used == 12 and report.frames_dropped == 0
    with pytest.raises(ConfigError):
        run_every_frame(RecordedSequence(sequence_dir), IsdfConfig(), 0, lambda *_: None)


def test_the_live_clock_keeps_to_its_budget_and_drops_frames(sequence_dir) -> None:
    slow = replace(IsdfConfig(), steps_per_frame=12)
    mapper, report = run_at_rate(RecordedSequence(sequence_dir), slow, 0.5, lambda *_: None)
    assert report.sequence_seconds == pytest.approx(1.2)
    assert 0.6 <= report.cpu_seconds < 1.0  # one step may overrun
    assert report.frames_dropped > 0 and report.frames_used + report.frames_dropped == 12
    assert mapper.steps == report.steps > 0
    with pytest.raises(ConfigError):
        run_at_rate(RecordedSequence(sequence_dir), slow, 0.0, lambda *_: None)


def test_the_step_clock_shows_the_frames_that_a_faster_machine_would_have_seen(sequence_dir) -> None:
    config = replace(IsdfConfig(), first_frame_steps=6, steps_per_frame=2, keyframe_steps=0)
    arrived: list[int] = []
    mapper, report = run_at_steps(
        RecordedSequence(sequence_dir), config, 10.0, lambda _, n: arrived.append(n)
    )
    # 10 frames and 10 steps a second: the first frame takes until frame 6, then every second one is seen.
    assert arrived == [6, 8, 10, 12] and mapper.steps == report.steps == 12
    assert report.frames_used == 4 and report.frames_dropped == 8
    for rate, bad in ((0.0, config), (10.0, replace(config, steps_per_frame=0))):
        with pytest.raises(ConfigError):
            run_at_steps(RecordedSequence(sequence_dir), bad, rate, lambda *_: None)


def test_watching_costs_the_mapper_no_time(sequence_dir) -> None:
    def busy(*_: object) -> None:
        end = time.process_time() + 0.3
        while time.process_time() < end:
            pass

    _, report = run_at_rate(RecordedSequence(sequence_dir), IsdfConfig(), 0.5, busy)
    assert 0.6 <= report.cpu_seconds < 1.0


def test_map_then_query(sequence_dir, tmp_path, monkeypatch, capsys) -> None:
    out = tmp_path / "run"
    run_cli(
        monkeypatch,
        "map",
        sequence_dir,
        "--out",
        out,
        "--method",
        "isdf",
        "--steps-per-frame",
        8,
        "--mesh-spacing",
        0.1,
    )
    report = json.loads((out / "report.json").read_text())
    assert report["steps"] == 96 and report["frames_used"] == 12
    assert len(trimesh.load(out / "mesh.ply").faces) == report["mesh_faces"] > 100
    assert Image.open(out / "slices.png").size[0] > 500
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3)) + np.array([0, 0, 1])
    np.save(tmp_path / "points.npy", points)
    run_cli(monkeypatch, "query", out, "--points", tmp_path / "points.npy", "--out", tmp_path / "answers.npz")
    answers = np.load(tmp_path / "answers.npz")
    assert answers["distance"].shape == (100,) and answers["gradient"].shape == (100, 3)
    field = IsdfMapper.load(out / "map.safetensors").field()
    expected = field.distance(torch.from_numpy(points.astype(np.float32)))
    np.testing.assert_allclose(answers["distance"], expected.numpy(), atol=1e-6)
    assert "100 points" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (("map", "nowhere", "--out", "x"), "not a recorded sequence"),
        (("map", "nowhere", "--out", "x", "--steps-per-frame", 1, "--cpu-per-second", 1), "give one of"),
        (("query", "nowhere", "--points", "p.npy", "--out", "x.npz"), "no such file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(words, fault, monkeypatch, capsys, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        run_cli(monkeypatch, *words)
    error = capsys.readouterr().err.strip()
    assert exit_info.value.code == 2 and fault in error and "\n" not in error
    assert list(tmp_path.iterdir()) == []


def test_up_is_judged_from_how_the_camera_is_held() -> None:
    poses = np.stack([f.T_world_camera.numpy() for f in furnished_orbit(12)])
    np.testing.assert_allclose(estimate_up(poses), [0, 0, 1])
    tilt = np.eye(4)
    tilt[:3, :3] = [[1, 0, 0], [0, 0.8, 0.6], [0, -0.6, 0.8]]
    np.testing.assert_allclose(estimate_up(tilt @ poses), [0, 0.6, 0.8], atol=0.05)
    # A robot that looks down on a table, turning its head a little, or not at all.
    looks = [look_at((0.0, 0.0, 1.2), (math.cos(a), math.sin(a), 0.5)) for a in np.linspace(-0.4, 0.4, 9)]
    assert -np.stack(looks)[:, 2, 1].mean() < np.cos(np.radians(25))
    np.testing.assert_allclose(estimate_up(np.stack(looks)), [0, 0, 1])
    lost = np.full((1, 4, 4), np.nan)
    np.testing.assert_allclose(estimate_up(np.concatenate([looks, lost])), [0, 0, 1])
    still = estimate_up(np.stack(looks[4:5]))
    np.testing.assert_allclose(still, -looks[4][:3, 1], atol=1e-6)
    basis = slice_basis(np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(basis, np.eye(3))


@pytest.mark.skipif("ISDF_DATA_DIR" not in os.environ, reason="ISDF_DATA_DIR is not set")
@pytest.mark.parametrize("name", ["seq_7scenes", "seq_tum_fr3_cabinet58"])
def test_real_sequences_are_learned(name) -> None:
    sequence = RecordedSequence(Path(os.environ["ISDF_DATA_DIR"]) / name)
    mapper = IsdfMapper(replace(IsdfConfig(), first_frame_steps=30, steps_per_frame=15, keyframe_steps=0))
    picks = range(0, len(sequence), max(1, len(sequence) // 12))
    for index in picks:
        mapper.integrate(sequence[index])
    field = mapper.field()
    # A frame that was not shown: its surface is near the zero level, the space half way to it is free.
    held_out = sequence[picks[5] + 1]
    surface = held_out.thinned(8, 4.0)
    eye = held_out.T_world_camera[:3, 3].float()
    assert field.distance(surface).abs().median() < 0.06
    assert (field.distance(eye + 0.5 * (surface - eye)) > 0.05).float().mean() > 0.95
