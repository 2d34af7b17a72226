"""What `benchmarks.realtime` aims at, and how true the confidence of a map is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.tables import NAMES, markdown
from isdf.evaluation import roc_area
from isdf.evaluation.figures import save_small
from isdf.evaluation.metrics import UNSAFE

# Greatest value of each column, by the kind of sequence that its name ends with.
TARGETS: dict[str, dict[str, float]] = {
    "nav": {"end": 1.3, "mean": 2.0, "1-cos": 0.05, "cost": 0.008, "ratio": 0.5, "over": 0.02},
    "obj": {"end": 0.7, "mean": 1.0, "1-cos": 0.03, "cost": 0.005, "ratio": 0.12, "over": 0.02},
    "mnp": {"near": 1.5, "end": 3.4, "mean": 5.0, "1-cos": 0.14, "cost": 0.02, "ratio": 0.33, "over": 0.06},
}
EVERYWHERE = {"MB": 5.0, "age": 0.5, "CPU": 1.0}
# Of the field 300,000 queries a second; of it or the baked one, whichever is faster, 3 million.
LEAST = {"auc": 0.9, "M/s": 0.3, "baked": 3.0}
BINS = 10


# Columns of the table, with the factor and the digits they are shown with.
SHOWN: dict[str, tuple[str, float, int]] = {
    "end": ("SDF error [cm], end", 1, 2),
    "mean": ("mean over time", 1, 2),
    "near": ("below 0.3 m", 1, 2),
    "unseen": ("unseen", 1, 1),
    "1-cos": ("gradient 1-cos", 1, 3),
    "cost": ("cost error [cm]", 100, 2),
    "over": ("over by > 5 cm [%]", 100, 1),
    "auc": ("confidence, ROC area", 1, 3),
    "CPU": ("CPU s a second", 1, 2),
    "age": ("age, greatest [s]", 1, 2),
    "MB": ("field [MB]", 1, 1),
}


def table(rows: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """A line a sequence and method, in Markdown.

    Args:
        rows: sequence -> method -> column -> value.
    """
    lines = []
    for name, methods in rows.items():
        for method, row in methods.items():
            cells = [
                "-" if row[column] is None else f"{factor * row[column]:.{digits}f}"
                for column, (_, factor, digits) in SHOWN.items()
            ]
            lines.append([f"{name}, {NAMES[method]}", *cells])
    return markdown(["sequence and map", *(head for head, _, _ in SHOWN.values())], lines)


def target_lines(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One line a target: what each sequence of the kind got, and whether that is within it.

    Args:
        rows: sequence -> column -> value; the last part of a sequence's name is its kind.
    """
    lines = ["target                       " + "got"]
    for kind, targets in TARGETS.items():
        here = {name: row for name, row in rows.items() if name.endswith(kind)}
        if not here:
            continue
        for column, most in (targets | EVERYWHERE).items():
            lines.append(
                _line(f"{kind} {column} <= {most:g}", here, column, lambda value, m=most: value / m - 1)
            )
        for column, least in LEAST.items():
            lines.append(
                _line(f"{kind} {column} >= {least:g}", here, column, lambda value, m=least: 1 - value / m)
            )
    return lines


def _line(label: str, rows: Mapping[str, Mapping[str, Any]], column: str, excess: Any) -> str:
    cells = []
    for name, row in rows.items():
        value = row[column]
        if column == "baked":
            value = max(value, row["M/s"])
        if value is None or not np.isfinite(value):
            cells.append(f"{name} -")
            continue
        miss = excess(value)
        cells.append(f"{name} {value:.3g} " + ("met" if miss <= 0 else f"MISSED by {100 * miss:.0f} %"))
    return f"{label:<28} " + "; ".join(cells)


@dataclass
class Reliability:
    """Confidences and errors of many points, visible and unseen."""

    sure: dict[str, list[Tensor]] = field(default_factory=lambda: {"visible": [], "unseen": []})
    wrong: dict[str, list[Tensor]] = field(default_factory=lambda: {"visible": [], "unseen": []})

    def add(self, sure_visible: Tensor, sure_unseen: Tensor, visible: Tensor, unseen: Tensor) -> None:
        """Points of one sequence: confidences, then errors [m]."""
        for name, sure, wrong in (("visible", sure_visible, visible), ("unseen", sure_unseen, unseen)):
            self.sure[name].append(sure)
            self.wrong[name].append(wrong)


def save_reliability(path: Path, points: Reliability) -> None:
    """Draw, against the confidence, the share of points that are right to 5 cm, and how many there are.

    Points on the diagonal are as often right as the map says.
    """
    figure = Figure(figsize=(7, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    top.plot([0, 1], [0, 1], color="grey", linestyle=":", label="as often right as said")
    groups = {name: (torch.cat(points.sure[name]), torch.cat(points.wrong[name])) for name in points.sure}
    groups["together"] = (
        torch.cat([sure for sure, _ in groups.values()]),
        torch.cat([wrong for _, wrong in groups.values()]),
    )
    edges = np.linspace(0, 1, BINS + 1)
    for number, (name, (sure, wrong)) in enumerate(groups.items()):
        where = np.clip(np.digitize(sure.numpy(), edges) - 1, 0, BINS - 1)
        right, count = (wrong.abs() <= UNSAFE).numpy(), np.bincount(where, minlength=BINS)
        filled = count > 20
        share = np.bincount(where, weights=right, minlength=BINS)[filled] / count[filled]
        said = np.bincount(where, weights=sure.numpy(), minlength=BINS)[filled] / count[filled]
        area = roc_area(sure, wrong)
        label = f"{name}: area under the ROC curve {area:.3f}" if area is not None else name
        top.plot(said, share, marker="o", color=f"C{number}", label=label)
        if name != "together":
            bottom.stairs(count / len(sure), edges, color=f"C{number}", label=name)
    top.set_ylabel(f"share of points right to {100 * UNSAFE:.0f} cm")
    top.legend(fontsize=9)
    bottom.set_xlabel("confidence")
    bottom.set_ylabel("share of points")
    bottom.set_yscale("log")
    bottom.legend(fontsize=9)
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    save_small(figure, path, 80)
