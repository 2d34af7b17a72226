"""What a prompt and a notebook show of trajectories and results."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from planning import PlanResult, Status, Trajectory

LINE = Trajectory.line(torch.tensor([0.0, -1.0]), torch.tensor([1.5, 0.25]), 4, 2.0)
RESULT = PlanResult(LINE, Status.SUCCESS, "clear by 3 cm <near 'arm'>", 0.0312, (3.0, 2.0), 2, 0.1234)


def test_a_trajectory_tells_its_ends_and_draws_its_joints() -> None:
    assert repr(LINE) == "<Trajectory: 4 waypoints of 2 joints in 2.00 s, from (0.00 -1.00) to (1.50 0.25)>"
    axes = LINE.plot(["shoulder", "elbow"]).axes[0]
    assert [line.get_label() for line in axes.lines] == ["shoulder", "elbow"]
    assert axes.lines[1].get_ydata()[-1] == pytest.approx(0.25) and axes.lines[1].get_xdata()[-1] == 2.0
    assert LINE._repr_png_()[1:4] == b"PNG" and len(LINE._repr_png_()) > 5000


def test_a_result_tells_its_verdict_in_a_line_and_in_a_table() -> None:
    assert repr(RESULT) == (
        "<PlanResult: success, clearance 3.1 cm, waypoints 4 in 2.00 s, iterations 2, planned in 0.123 s>"
    )
    table = RESULT._repr_html_()
    assert "color:green" in table and "clear by 3 cm &lt;near &#x27;arm&#x27;&gt;" in table
    failed = replace(RESULT, status=Status.COLLISION, clearance=math.nan)
    assert "color:red" in failed._repr_html_() and "<PlanResult: collision, clearance nan cm" in repr(failed)
