"""Compiled code checks no index by itself: one beyond an array reads and writes other memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TESTED = (
    "tests/isdf/test_mapping.py",
    "tests/isdf/test_interpolation.py",
    "tests/isdf/test_visitors.py",
    "tests/isdf/test_seeds.py",
    "tests/isdf/test_voxel.py",
    "tests/isdf/test_wavefronts.py",
    "tests/planning/test_exact_shape.py",
    "tests/planning/test_collision_monitor.py",
)


@pytest.mark.slow
def test_compiled_code_stays_within_its_arrays(tmp_path: Path) -> None:
    checked = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    outcome = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTED],
        cwd=ROOT,
        env=os.environ | checked,
        capture_output=True,
        text=True,
    )
    assert outcome.returncode == 0, outcome.stdout[-3000:]
