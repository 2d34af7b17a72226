"""Recorded sequences agree with the truth beside them, and an interrupted recording never looks finished."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from examples import record_sequences
from examples.camera_tour import Leg
from examples.home_tours import TOURS, HomeTour
from examples.record_sequences import RecordSequences
from isdf.datasets import RecordedSequence
from robots.simulation import load_truth

SHORT = HomeTour("home_1", (-0.4, -1.1, -0.4), (Leg(((-0.1, -1.2),), "grasp_object", linger=0.3),))


@pytest.fixture(autouse=True, scope="module")
def _short_tours():
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(TOURS, "short", SHORT)
        yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("sequences")
    counts = record_sequences.main(RecordSequences(out, only=("short",), width=64))
    assert list(counts) == ["short"] and counts["short"] > 20
    return out / "short"


def test_frames_agree_with_the_truth(folder) -> None:
    noisy, exact = RecordedSequence(folder), RecordedSequence(folder / "noise_free")
    truth = load_truth(folder / "truth.json")
    assert noisy.fps == pytest.approx(30.0) and len(noisy) == len(exact)
    assert np.array_equal(noisy.poses, exact.poses)
    cameras = torch.from_numpy(noisy.poses[:, :3, 3])
    assert truth.field.distance(cameras).min() > 0.1
    assert ((cameras >= torch.tensor(truth.room[0])) & (cameras <= torch.tensor(truth.room[1]))).all()
    speed = (cameras[1:] - cameras[:-1]).norm(dim=1) * noisy.fps
    assert speed.mean() > 0.02 and speed.max() < 1.0
    gaps = []
    for index in range(0, len(exact), 7):
        surface = exact[index].thinned(1, 9.9)
        assert truth.field.distance(surface).abs().quantile(0.99) < 0.002
        both = (noisy[index].depth > 0) & (exact[index].depth > 0)
        gaps.append((noisy[index].depth - exact[index].depth)[both].abs().mean())
    assert 0.001 < torch.stack(gaps).mean() < 0.05  # there is noise, and it is that of a depth camera


def test_finished_is_kept_and_interrupted_starts_anew(folder, monkeypatch) -> None:
    before = (folder / "poses.txt").stat().st_mtime_ns
    record_sequences.main(RecordSequences(folder.parent, only=("short",), width=64))
    assert (folder / "poses.txt").stat().st_mtime_ns == before
    again = folder.parent / "again"

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(record_sequences, "save_truth", interrupted)
        record_sequences.main(RecordSequences(again, only=("short",), width=64))
    assert not (again / "short").exists()
    record_sequences.main(RecordSequences(again, only=("short",), width=64))
    assert len(RecordedSequence(again / "short")) == len(RecordedSequence(folder))
    assert [p.name for p in again.iterdir()] == ["short"]


def test_unknown_names_list_the_known(tmp_path) -> None:
    with pytest.raises(SystemExit, match="no sequence named apt_9_nav; choose from apt_1_nav, apt_1_obj"):
        RecordSequences(tmp_path, only=("apt_9_nav",))
