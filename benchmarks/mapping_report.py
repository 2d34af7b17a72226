"""Tables and figures of the mapping experiments, from the files that `benchmarks.mapping` left.

    python -m benchmarks.mapping_report runs/mapping
    python -m benchmarks.mapping_report runs/mapping --publish docs/results.md

Leaves OUT/report/tables.md and pictures beside it. With --publish the tables also take their places in a Markdown
page, between `<!-- NAME -->` and `<!-- /NAME -->`, and the pictures go to images/results beside the page.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm import tqdm

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import tables
from benchmarks.publishing import publish
from benchmarks.shading import dollhouse
from benchmarks.tables import NAMES, Result
from isdf.datasets import open_sequence
from isdf.evaluation.figures import save_bars, save_curves, save_picture_row, save_slice_comparison
from isdf.meshing import zero_level_mesh
from isdf.methods import load_map
from robots.simulation import load_truth

EXPERIMENTS = ("main", "half", "bounds", "fidelity", "real")
TABLES: dict[str, Callable[[Sequence[Result]], str]] = {
    "summary": tables.summary,
    "sequences": tables.by_sequence,
    "bins": tables.binned,
    "resources": tables.resources,
    "stages": tables.stages,
}
CURVES = {"SDF error [cm]": ("sdf_error", 100.0), "cost error [cm]": ("cost_error", 100.0),
          "gradient 1-cos": ("gradient_distance", 1.0)}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Make tables and figures of mapping experiments."""

    out: tyro.conf.Positional[Path]
    """Folder that `python -m benchmarks.mapping` wrote."""
    publish: Path | None = None
    """A Markdown page whose marked parts get the tables."""
    heights: tuple[float, ...] = (0.4, 0.9)
    """Heights of the slices [m]."""
    mesh_spacing: float = 0.04
    """Cell size of the meshes [m]."""
    pictures: bool = True
    """Draw slices and meshes anew, which takes half a minute a sequence; without, a page keeps those drawn before."""


def main(options: Options) -> list[Path]:
    """Write everything; returns the files."""
    torch.set_num_threads(1)
    report = options.out / "report"
    report.mkdir(parents=True, exist_ok=True)
    results = {name: tables.read_results(options.out, name) for name in EXPERIMENTS}
    results = {name: found for name, found in results.items() if found}
    if not results:
        raise SystemExit(f"{options.out}: no results; run `python -m benchmarks.mapping main` first")
    parts = {f"{name}-{part}": text for name, found in results.items() for part, text in _tables(name, found)}
    page = "".join(f"## {name}\n\n{text}\n" for name, text in parts.items())
    (report / "tables.md").write_text(page)
    written = [report / "tables.md", *_charts(report, results)]
    if options.pictures and "main" in results:
        for name in tqdm(tables.sequences(results["main"]), desc="pictures", unit="sequence", disable=None):
            written += _pictures(options, report, name, results["main"])
    if options.publish:
        publish(options.publish, parts, sorted(report.glob("*.png")))
    return written


def _tables(experiment: str, results: Sequence[Result]) -> list[tuple[str, str]]:
    if experiment == "real":
        return [("held-out", tables.real(results)), ("resources", tables.resources(results))]
    return [(name, make(results)) for name, make in TABLES.items()]


def _charts(folder: Path, results: dict[str, list[Result]]) -> list[Path]:
    """Curves over time, binned errors, and the bars of the ablations."""
    made = []
    for name in ("main", "half", "fidelity"):
        if name in results:
            made.append(folder / f"{name}_curves.png")
            save_curves(made[-1], _curves(results[name]))
    if "main" in results:
        made.append(folder / "bins.png")
        bins = {
            label: {
                NAMES[m]: _mean([r for r in results["main"] if r["method"] == m], tables.in_bin(i))
                for m in tables.methods(results["main"])
            }
            for i, label in enumerate(tables.bin_names())
        }
        save_bars(made[-1], bins, "SDF error [cm]")
    for name in ("bounds", "fidelity"):
        if name in results:
            made.append(folder / f"{name}.png")
            _save_ablation(made[-1], results[name])
    return made


def _mean(results: Sequence[Result], value: tables.Value) -> float | None:
    found = tables.spread(results, value)
    return 100 * found[0] if found else None


def _save_ablation(path: Path, results: Sequence[Result]) -> None:
    """Bars of the SDF error at the end by sequence and method, with the spread over seeds."""
    groups: dict[str, dict[str, float | None]] = {}
    spread: dict[str, dict[str, float]] = {}
    for name in [*tables.sequences(results), "mean"]:
        for method in tables.methods(results):
            mine = [r for r in results if r["method"] == method]
            mine = (
                _of_whole_seeds(mine, results)
                if name == "mean"
                else [r for r in mine if r["sequence"] == name]
            )
            found = tables.spread(mine, tables.at_end("sdf_error"))
            groups.setdefault(name, {})[NAMES[method]] = 100 * found[0] if found else None
            spread.setdefault(name, {})[NAMES[method]] = 100 * found[1] if found else 0.0
    save_bars(path, groups, "SDF error at the end [cm]", spread)


def _of_whole_seeds(mine: Sequence[Result], results: Sequence[Result]) -> list[Result]:
    """Results of a method from the seeds that have every sequence: a mean of other ones could not be compared."""
    every = set(tables.sequences(results))
    done: dict[int, set[str]] = {}
    for result in mine:
        done.setdefault(result["seed"], set()).add(result["sequence"])
    return [result for result in mine if done[result["seed"]] == every]


def _curves(results: Sequence[Result]) -> dict:
    """Metric -> sequence -> method -> runs; the mean over sequences is by the evaluation's number from the start."""
    panels: dict = {}
    for label, (name, scale) in CURVES.items():
        for sequence in tables.sequences(results):
            for method in tables.methods(results):
                runs = [
                    _curve(r, name, scale)
                    for r in results
                    if (r["sequence"], r["method"]) == (sequence, method)
                ]
                if runs:
                    panels.setdefault(label, {}).setdefault(sequence, {})[NAMES[method]] = runs
        if len(panels[label]) > 1:
            panels[label]["mean"] = _mean_curves(list(panels[label].values()))
    return panels


def _curve(result: Result, name: str, scale: float) -> tuple[list[float], list[float]]:
    moments = result["over_time"]
    return [m["time"] for m in moments], [
        scale * m["visible"][name] if m["visible"] else np.nan for m in moments
    ]


def _mean_curves(by_sequence: list[dict]) -> dict:
    """Mean over the sequences, up to the end of the shortest, of the methods that have them all."""
    length = min(len(runs[0][0]) for methods in by_sequence for runs in methods.values())
    mean = {}
    for method in by_sequence[0]:
        if all(method in methods for methods in by_sequence):
            runs = [run for methods in by_sequence for run in methods[method]]
            times, values = zip(*((t[:length], v[:length]) for t, v in runs), strict=True)
            mean[method] = [(np.mean(times, axis=0), np.mean(values, axis=0))]
    return mean


def _pictures(options: Options, folder: Path, name: str, results: Sequence[Result]) -> list[Path]:
    """Slices and meshes of one sequence: the truth and every method, its first seed."""
    study = json.loads((options.out / "study.json").read_text())
    source = Path(study["sequences"]) / name
    truth = load_truth(source / "truth.json")
    room = torch.as_tensor(np.asarray(truth.room), dtype=torch.float32)
    fields, keyframes = {"truth": truth.field}, {}
    for result in results:
        title = NAMES[result["method"]]
        if result["sequence"] == name and title not in fields:
            key = f"{name}__{result['method'].replace(' ', '_')}__{result['seed']}"
            fields[title] = load_map(options.out / "maps" / "main" / f"{key}.safetensors").field()
            keyframes[title] = np.array(result["keyframes"]).reshape(-1, 3)
    slices, meshes = folder / f"slices_{name}.png", folder / f"meshes_{name}.png"
    poses = open_sequence(source).poses
    save_slice_comparison(
        slices, fields, options.heights, room, poses, keyframes, predictive=[NAMES["default"], NAMES["isdf"]]
    )
    views = {
        title: dollhouse(zero_level_mesh(field, options.mesh_spacing, room, padding=0.06), room.numpy())
        for title, field in fields.items()
    }
    save_picture_row(meshes, views)
    return [slices, meshes]


if __name__ == "__main__":
    print("\n".join(map(str, main(tyro.cli(Options)))))
