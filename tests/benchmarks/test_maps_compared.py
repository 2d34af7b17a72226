"""The same drives by several maps, side by side."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.maps_compared import Options, main, read_reports


def write(out: Path, method: str, number: int, **changes: object) -> None:
    report = {
        "reached": True,
        "contacts": {},
        "contacts_rechecked": {},
        "length_ratio": 1.1,
        "drive": {"duration": 30.0 + number},
        "planning_times": [0.1, 0.3],
        "cpu_seconds": 40.0,
    } | changes
    folder = out / "hall" / method / "none" / f"{number:03d}"
    folder.mkdir(parents=True)
    (folder / "report.json").write_text(json.dumps(report))


def test_only_what_all_maps_drove_is_compared_and_published(tmp_path: Path) -> None:
    for number in range(4):
        write(tmp_path, "default", number)
    write(tmp_path, "exact", 0, reached=False, length_ratio=9.0, planning_times=[])
    write(tmp_path, "exact", 1, contacts_rechecked={"arm - wall": 0.01}, length_ratio=1.3)
    write(tmp_path, "truth", 0)
    write(tmp_path, "truth", 1)
    page = tmp_path / "page.md"
    page.write_text("# R\n<!-- maps -->\nold\n<!-- /maps -->\n![](images/results/maps.png)\n")
    text = main(Options(tmp_path, "hall", publish=page))
    rows = {
        line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]] for line in text.splitlines()
    }
    assert rows["default map"][:6] == ["2", "100", "0", "1.10", "1.10", "30"]
    assert rows["exact distances"][:6] == ["2", "50", "50", "1.30", "1.30", "31"]
    assert rows["ground truth"][6:] == ["0.20", "0.30", "40"]
    assert text in page.read_text() and "old" not in page.read_text()
    assert np.asarray(Image.open(tmp_path / "images" / "results" / "maps.png").convert("L")).std() > 5


def test_an_episode_that_ended_in_an_error_counts_as_not_reached(tmp_path: Path) -> None:
    for method in ("default", "truth"):
        write(tmp_path, method, 0)
    folder = tmp_path / "hall" / "default" / "none" / "000"
    (folder / "report.json").write_text(json.dumps({"success": False, "error": "ValueError: no"}))
    assert "| default map | 1 | 0 | 0 | - | - | - | - | - | - |" in main(Options(tmp_path, "hall"))


def test_one_map_is_nothing_to_compare(tmp_path: Path) -> None:
    write(tmp_path, "default", 0)
    assert list(read_reports(tmp_path / "hall", "none")) == ["default"]
    with pytest.raises(SystemExit, match=r"two maps or more.*found those of default"):
        main(Options(tmp_path, "hall"))
    with pytest.raises(SystemExit, match="found those of none"):
        main(Options(tmp_path, "hall", disturb="people"))
