"""Tables that benchmarks put into pages."""

from __future__ import annotations

import pytest

from benchmarks.large_spaces import Row
from benchmarks.large_spaces import table as spaces
from benchmarks.publishing import publish
from benchmarks.realtime import Realtime
from benchmarks.realtime import main as run_live
from benchmarks.realtime_report import SHOWN
from benchmarks.realtime_report import table as realtime


def test_a_live_run_is_shown_with_units_and_gaps(tmp_path) -> None:
    row = dict.fromkeys(SHOWN, 0.0148) | {"auc": None}
    text = realtime({"apt_1_nav": {"exact": row, "default": row}})
    head, _, exact, default = text.strip().splitlines()
    cells = [cell.strip() for cell in default.strip("|").split("|")]
    assert cells[0] == "apt_1_nav, default map" and "exact distances" in exact
    assert len(cells) == len(head.strip("|").split("|")) == 1 + len(SHOWN)
    assert cells[1 + list(SHOWN).index("cost")] == "1.48" and cells[1 + list(SHOWN).index("auc")] == "-"
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- realtime -->\nold\n<!-- /realtime -->\nafter\n")
    publish(page, {"realtime": text}, [])
    assert "old" not in page.read_text() and default in page.read_text() and "after" in page.read_text()


def test_spaces_are_shown_by_halves() -> None:
    rows = [Row("room", 10.0 + n, 1.0 + n, 0.5 + n, 20.0 + 10 * (n > 1), 0.1) for n in range(4)]
    line = spaces([*rows, *(Row("house", 99.0, 9.0, 8.0, 40.0, 0.2) for _ in range(2))]).splitlines()[2]
    assert line == "| room | 13 | 4 | 3.5 | 20 | 30 | 0.10 |"


@pytest.mark.parametrize("only", [(), ("apt_9_nav",)])
def test_sequences_that_are_not_there_are_named(tmp_path, only) -> None:
    with pytest.raises(SystemExit, match=r"no sequence (any|apt_9_nav) with a truth\.json, only none"):
        run_live(Realtime(sequences=tmp_path, only=only, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
