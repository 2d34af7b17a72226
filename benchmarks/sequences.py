"""Which recorded sequences of a folder a benchmark takes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

RECORD = "run `python -m examples.record_sequences` first"


def chosen(
    folder: Path,
    only: Sequence[str],
    among: Collection[str] | None = None,
    mark: str = "truth.json",
    advice: str = RECORD,
) -> list[str]:
    """Names of the sequences to take.

    Args:
        folder: has a folder of each sequence.
        only: which; all that are there if empty.
        among: names that the benchmark can take; any if None.
        mark: file by which a sequence is known.
        advice: what to do where one is not there.

    Raises:
        SystemExit: one of `only` is not there, or none at all.
    """
    there = sorted(p.parent.name for p in folder.glob(f"*/{mark}") if among is None or p.parent.name in among)
    names = list(only) or there
    if not names or set(names) - set(there):
        lacking = ", ".join(sorted(set(names) - set(there))) or "any"
        raise SystemExit(
            f"{folder}: no sequence {lacking} with a {mark}, only {', '.join(there) or 'none'}; {advice}"
        )
    return names
