"""Which map matters: the same drives by every map, side by side.

    for map in default isdf voxblox kinectfusion exact truth; do
        python -m benchmarks.closed_loop navigate --scene home_1 --episodes 50 --method $map --out runs/closed_loop
    done
    python -m benchmarks.maps_compared runs/closed_loop --scene home_1 --publish docs/results.md

Writes OUT/maps.md and OUT/maps.png from the episodes' reports. Only episodes that every map has driven are compared.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.publishing import publish
from benchmarks.tables import NAMES
from isdf.evaluation.figures import save_small

Reports = Sequence[dict]
ORDER = ("default", "isdf", "voxblox", "fiesta", "kinectfusion", "exact", "truth")


@dataclass(frozen=True)
class Options:
    """Compare the maps that the same episodes were driven by."""

    out: tyro.conf.Positional[Path]
    """Folder that `python -m benchmarks.closed_loop navigate` wrote."""
    scene: str = "home_1"
    """Name of the scene."""
    disturb: str = "none"
    """What disturbed the episodes."""
    publish: Path | None = None
    """A Markdown page whose part marked `maps` gets the table."""


def main(options: Options) -> str:
    """Write the table and the picture; returns the table."""
    found = read_reports(options.out / options.scene, options.disturb)
    if len(found) < 2:
        raise SystemExit(
            f"{options.out / options.scene}: needs episodes of two maps or more with --disturb {options.disturb}, "
            f"found those of {', '.join(found) or 'none'}; run benchmarks.closed_loop navigate --method MAP first"
        )
    text, picture = table(found), options.out / "maps.png"
    (options.out / "maps.md").write_text(text)
    save_picture(picture, found)
    if options.publish:
        publish(options.publish, {"maps": text}, [picture])
    return text


def read_reports(scene: Path, disturb: str) -> dict[str, Reports]:
    """The reports of every map, of those episodes that all of them have."""
    found: dict[str, dict[str, dict]] = {}
    for method in ORDER:
        files = sorted((scene / method / disturb).glob("*/report.json"))
        if files:
            found[method] = {file.parent.name: json.loads(file.read_text()) for file in files}
    shared = sorted(set.intersection(*(set(reports) for reports in found.values()))) if found else []
    return {method: [reports[number] for number in shared] for method, reports in found.items()}


def reached(reports: Reports) -> float:
    """Share of the episodes that reached the goal [%]."""
    return 100 * float(np.mean([bool(r.get("reached")) for r in reports]))


def touched(reports: Reports) -> float:
    """Share of the episodes with any contact, by either count [%]."""
    return 100 * float(np.mean([bool(r.get("contacts") or r.get("contacts_rechecked")) for r in reports]))


def length(quantile: float) -> Callable[[Reports], float]:
    """Quantile of the length over that of the shortest way, of episodes that reached the goal."""
    return lambda reports: _quantile([r["length_ratio"] for r in reports if r.get("reached")], quantile)


def planning(quantile: float) -> Callable[[Reports], float]:
    """Quantile of the time for a plan [s]."""
    return lambda reports: _quantile([t for r in reports for t in r.get("planning_times", ())], quantile)


def duration(reports: Reports) -> float:
    """Median duration of the episodes that reached the goal [s]."""
    return _quantile([r["drive"]["duration"] for r in reports if r.get("reached")], 0.5)


def cpu(reports: Reports) -> float:
    """Median CPU time of an episode, simulation and all [s]."""
    return _quantile([r["cpu_seconds"] for r in reports if "cpu_seconds" in r], 0.5)


COLUMNS: dict[str, tuple[Callable[[Reports], float], str]] = {
    "reached [%]": (reached, ".0f"),
    "with a contact [%]": (touched, ".0f"),
    "length / shortest, median": (length(0.5), ".2f"),
    "95 %": (length(0.95), ".2f"),
    "duration, median [s]": (duration, ".0f"),
    "planning, median [s]": (planning(0.5), ".2f"),
    "planning, 95 % [s]": (planning(0.95), ".2f"),
    "CPU an episode [s]": (cpu, ".0f"),
}
PANELS = (
    "reached [%]",
    "with a contact [%]",
    "length / shortest, median",
    "duration, median [s]",
    "planning, 95 % [s]",
)


def table(found: dict[str, Reports]) -> str:
    """A row a map."""
    head = ["map", "episodes", *COLUMNS]
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    for method, reports in found.items():
        values = [(value(reports), form) for value, form in COLUMNS.values()]
        cells = [f"{v:{form}}" if np.isfinite(v) else "-" for v, form in values]
        rows.append([_name(method), str(len(reports)), *cells])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def save_picture(path: Path, found: dict[str, Reports]) -> None:
    """A panel a figure, a bar a map."""
    figure = Figure(figsize=(11.0, 2.6), layout="constrained")
    names = [_name(method) for method in found]
    panels = figure.subplots(1, len(PANELS), sharey=True)
    panels[0].invert_yaxis()
    for ax, title in zip(panels, PANELS, strict=True):
        value, form = COLUMNS[title]
        values = [value(reports) for reports in found.values()]
        bars = ax.barh(names, np.nan_to_num(values), color=[f"C{i}" for i in range(len(names))])
        ax.bar_label(bars, [f"{v:{form}}" if np.isfinite(v) else "-" for v in values], padding=2, fontsize=8)
        ax.set_title(title, fontsize=9)
        ax.set_xlim(0, 1.3 * (np.nan_to_num(values).max() or 1))
    save_small(figure, path, 90)


def _name(method: str) -> str:
    return "ground truth" if method == "truth" else NAMES[method]


def _quantile(values: Sequence[float], quantile: float) -> float:
    return float(np.quantile(values, quantile)) if values else float("nan")


if __name__ == "__main__":
    print(main(tyro.cli(Options, description=__doc__)))
