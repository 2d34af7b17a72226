"""Tables (Markdown) of the results that `benchmarks.mapping` left."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from isdf.evaluation import BINS

Result = dict[str, Any]
Value = Callable[[Result], float | None]
# Order and names of the methods in every table and figure.
NAMES = {
    "default": "default map",
    "isdf": "iSDF (ours)",
    "voxblox": "Voxblox",
    "fiesta": "FIESTA",
    "kinectfusion": "KinectFusion+",
    "exact": "exact distances",
    "seen": "all surface seen, without noise",
    "isdf ray": "ray",
    "isdf normal": "normal",
    "isdf batch": "batch",
}


def read_results(out: Path, experiment: str) -> list[Result]:
    """All results of one experiment, by method in the order of NAMES, then sequence and seed."""
    found = [json.loads(path.read_text()) for path in (out / experiment).glob("*.json")]
    order = list(NAMES)
    return sorted(found, key=lambda r: (order.index(r["method"]), r["sequence"], r["seed"]))


def methods(results: Sequence[Result]) -> list[str]:
    """Labels in order."""
    return list(dict.fromkeys(r["method"] for r in results))


def sequences(results: Sequence[Result]) -> list[str]:
    """Names in order."""
    return sorted({r["sequence"] for r in results})


def at_end(name: str, region: str = "visible") -> Value:
    """A score at the end of the sequence."""
    return lambda result: (result["over_time"][-1][region] or {}).get(name)


def over_time(name: str, region: str = "visible") -> Value:
    """Mean of a score over the evaluation times; none when the method had no map at one of them."""

    def mean(result: Result) -> float | None:
        values = [(moment[region] or {}).get(name) for moment in result["over_time"]]
        return None if None in values else float(np.mean(values))

    return mean


def unseen(name: str) -> Value:
    """A score in the unseen free space at the end."""
    return lambda result: _of_points(result["unseen"], name)


def in_bin(index: int) -> Value:
    """SDF error at the end, in one bin of the true distance."""
    return lambda result: _of_points(result["over_time"][-1]["visible"]["bins"][index], "sdf_error")


def _of_points(scores: dict[str, Any], name: str) -> float | None:
    """A score, NaN where the sequence has no such points."""
    return scores[name] if scores["points"] else float("nan")


def entry(*keys: str) -> Value:
    """Any other number of a result."""

    def get(result: Result) -> float | None:
        value: Any = result
        for key in keys:
            value = value and value.get(key)
        return value

    return get


def spread(results: Sequence[Result], value: Value) -> tuple[float, float, int] | None:
    """Mean over sequences and seeds, standard deviation over seeds of the mean over sequences, number of seeds.

    Sequences that have no such points (NaN: nothing unseen, say) are left out, for every method alike. None where a
    method gave no answer: a mean of the others would flatter it.
    """
    by_seed: dict[int, list[float]] = {}
    for result in results:
        number = value(result)
        if number is None:
            return None
        if not np.isnan(number):
            by_seed.setdefault(result["seed"], []).append(number)
    means = [float(np.mean(numbers)) for numbers in by_seed.values()]
    if not means:
        return None
    every = [number for numbers in by_seed.values() for number in numbers]
    return float(np.mean(every)), float(np.std(means, ddof=1)) if len(means) > 1 else 0.0, len(means)


def cell(results: Sequence[Result], value: Value, scale: float = 1.0, digits: int = 2) -> str:
    """Mean, and standard deviation over seeds where there are several."""
    found = spread(results, value)
    if found is None:
        return "-"
    mean, deviation, seeds = found
    text = f"{scale * mean:.{digits}f}"
    return f"{text} ± {scale * deviation:.{digits}f}" if seeds > 1 else text


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; the first column to the left, numbers to the right."""
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, rule, *rows]) + "\n"


def summary(results: Sequence[Result]) -> str:
    """Every score, a row a method, mean over the sequences."""
    columns: list[tuple[str, Value, float, int]] = [
        ("SDF error [cm], end", at_end("sdf_error"), 100, 2),
        ("mean over time", over_time("sdf_error"), 100, 2),
        ("cost error [cm], end", at_end("cost_error"), 100, 2),
        ("mean over time", over_time("cost_error"), 100, 2),
        ("gradient 1-cos, end", at_end("gradient_distance"), 1, 3),
        ("mean over time", over_time("gradient_distance"), 1, 3),
        ("over by > 5 cm [%]", at_end("overestimated"), 100, 1),
        ("bias [cm]", at_end("bias"), 100, 2),
        ("SDF error in Voxblox's region [cm]", at_end("sdf_error", "voxblox_region"), 100, 2),
        ("SDF error unseen [cm]", unseen("sdf_error"), 100, 1),
        ("1-cos unseen", unseen("gradient_distance"), 1, 2),
    ]
    return _by_method(results, columns)


def resources(results: Sequence[Result]) -> str:
    """Time, steps and memory, a row a method, mean over the sequences."""
    columns: list[tuple[str, Value, float, int]] = [
        ("CPU s per s", entry("cpu_per_second"), 1, 2),
        ("frames used", entry("report", "frames_used"), 1, 0),
        ("of", entry("report", "frames"), 1, 0),
        ("steps or rebuilds", entry("report", "steps"), 1, 0),
        ("keyframes", entry("report", "keyframes"), 1, 0),
        ("query [us]", entry("query_us"), 1, 2),
        ("field [MB]", entry("memory", "field"), 1e-6, 1),
        ("state [MB]", entry("memory", "state"), 1e-6, 1),
        ("file [MB]", entry("memory", "file"), 1e-6, 1),
    ]
    return _by_method(results, columns)


def by_sequence(results: Sequence[Result]) -> str:
    """SDF error at the end / mean over time [cm], a row a sequence, a column a method."""
    rows = []
    for name in sequences(results):
        cells = [
            f"{cell(mine, at_end('sdf_error'), 100)} / {cell(mine, over_time('sdf_error'), 100)}"
            if mine
            else "-"
            for method in methods(results)
            for mine in [[r for r in results if r["sequence"] == name and r["method"] == method]]
        ]
        rows.append([name, *cells])
    return markdown(["SDF error [cm], end / mean", *(NAMES[m] for m in methods(results))], rows)


def bin_names() -> list[str]:
    """The bins of the true distance in words."""
    middle = [f"{a:g} to {b:g} m" for a, b in itertools.pairwise(BINS[1:-1])]
    return ["inside", *middle, f"over {BINS[-2]:g} m"]


def binned(results: Sequence[Result]) -> str:
    """SDF error at the end by true distance, mean over the sequences."""
    columns = [(f"{name} [cm]", in_bin(i), 100.0, 2) for i, name in enumerate(bin_names())]
    return _by_method(results, columns)


def stages(results: Sequence[Result]) -> str:
    """CPU time of the stages of a training step [ms]."""
    trained = [r for r in results if r["stages_ms"]]
    names = list(trained[0]["stages_ms"]) if trained else []
    return _by_method(trained, [(f"{name} [ms]", entry("stages_ms", name), 1.0, 1) for name in names])


def real(results: Sequence[Result]) -> str:
    """Held-out frames of real sequences: a row a method and sequence."""
    columns: list[tuple[str, str, float, int]] = [
        ("median [cm]", "median_error", 100, 2),
        ("mean [cm]", "mean_error", 100, 2),
        ("within 5 cm [%]", "within", 100, 1),
        ("no surface [%]", "missed", 100, 1),
        ("free space blocked [%]", "blocked", 100, 2),
        ("certainly over by > 5 cm [%]", "overestimated", 100, 2),
    ]
    rows = []
    for sequence in sequences(results):
        for method in methods(results):
            mine = [r for r in results if r["sequence"] == sequence and r["method"] == method]
            numbers = [cell(mine, entry("held_out", key), scale, digits) for _, key, scale, digits in columns]
            rows.append([f"{sequence}, {NAMES[method]}", *numbers])
    return markdown(["", *(title for title, *_ in columns)], rows)


def _by_method(results: Sequence[Result], columns: Sequence[tuple[str, Value, float, int]]) -> str:
    rows = []
    for method in methods(results):
        mine = [r for r in results if r["method"] == method]
        part, whole = len(sequences(mine)), len(sequences(results))
        title = NAMES[method] + ("" if part == whole else f" ({part} of {whole} sequences)")
        rows.append([title, *(cell(mine, value, scale, digits) for _, value, scale, digits in columns)])
    return markdown(["method", *(title for title, *_ in columns)], rows)
