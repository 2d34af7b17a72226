"""The figures of an evaluation: errors over time, bars, and slices of several fields side by side."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from ..slices import draw_slice

# Colours of a picture file: enough for a colour map, and a quarter of the size.
PALETTE = 256
Runs = Sequence[tuple[Sequence[float], Sequence[float]]]
"""Times and values of every run of one method."""


def save_curves(
    path: str | Path,
    panels: Mapping[str, Mapping[str, Mapping[str, Runs]]],
    dpi: int = 80,
) -> None:
    """Curves over time: a row a metric, a column a sequence, a line a method with the spread of its runs as a band.

    Args:
        path: of the PNG.
        panels: metric label -> sequence -> method -> runs.
        dpi: of the picture.
    """
    columns = max(len(row) for row in panels.values())
    names = list(dict.fromkeys(m for row in panels.values() for methods in row.values() for m in methods))
    colours = {name: f"C{number}" for number, name in enumerate(names)}
    figure = Figure(figsize=(max(7.0, 2.7 * columns), 2.2 * len(panels) + 0.4), layout="constrained")
    axes = figure.subplots(len(panels), columns, squeeze=False, sharey="row")
    for row, (label, sequences) in zip(axes, panels.items(), strict=True):
        row[0].set_ylabel(label)
        for ax, (sequence, methods) in zip(row, sequences.items(), strict=False):
            for name, runs in methods.items():
                _curve(ax, runs, colours[name])
            ax.set_title(sequence if ax in axes[0] else "", fontsize=10)
            ax.set_xlabel("time [s]" if ax in axes[-1] else "")
            ax.grid(alpha=0.3)
        row[0].set_ylim(bottom=0)  # last: it ends the scaling to what is drawn
    lines = [axes[0, 0].plot([], [], color=colour)[0] for colour in colours.values()]
    figure.legend(lines, names, loc="outside lower center", ncols=len(names))
    save_small(figure, path, dpi)


def _curve(ax: Any, runs: Runs, colour: str) -> None:
    times = np.array(runs[0][0])
    values = np.array([v for _, v in runs])
    ax.plot(times, values.mean(axis=0), color=colour, marker=".", linewidth=1.4)
    if len(values) > 1:
        ax.fill_between(times, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.2, linewidth=0)


def save_bars(
    path: str | Path,
    groups: Mapping[str, Mapping[str, float | None]],
    label: str,
    spread: Mapping[str, Mapping[str, float]] | None = None,
    dpi: int = 90,
) -> None:
    """Bars in groups; a missing value leaves a gap.

    Args:
        path: of the PNG.
        groups: group -> bar -> value; bars of one name share a colour.
        label: of the values.
        spread: half the length of the error bars, in the same shape.
        dpi: of the picture.
    """
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    # Room for the bars of a group and for its name [inch].
    width = max(0.28 * (len(names) + 1), 0.1 + 0.1 * max(map(len, groups)))
    figure = Figure(figsize=(1.2 + width * len(groups), 2.9), layout="constrained")
    ax = figure.subplots()
    for number, name in enumerate(names):
        at = np.arange(len(groups)) + (number - (len(names) - 1) / 2) * 0.8 / len(names)
        heights = [np.nan if (v := group.get(name)) is None else v for group in groups.values()]
        errors = [spread.get(group, {}).get(name, 0.0) for group in groups] if spread else None
        ax.bar(at, heights, 0.75 / len(names), yerr=errors, color=f"C{number}", label=name, capsize=2)
    ax.set_xticks(range(len(groups)), list(groups))
    ax.set_ylabel(label)
    ax.grid(axis="y", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=len(names), fontsize=9)
    save_small(figure, path, dpi)


def save_slice_comparison(
    path: str | Path,
    fields: Mapping[str, Any],
    heights: Sequence[float],
    bounds: Float[Tensor, "2 3"],
    poses: Float[np.ndarray, "n 4 4"],
    keyframes: Mapping[str, Float[np.ndarray, "k 3"]],
    predictive: Sequence[str] = (),
    dpi: int = 60,
) -> None:
    """Slices of several fields at the same heights, with the camera's path in red and keyframes in green.

    Args:
        path: of the PNG.
        fields: by title, one a column; z is up.
        heights: one a row [m].
        bounds: region that is drawn [m].
        poses: T_world_camera of the sequence.
        keyframes: camera positions to mark in the columns of some titles [m].
        predictive: titles of fields that are drawn where they have no confidence, too.
        dpi: of the picture.
    """
    size = (bounds[1] - bounds[0]).numpy()
    figure = Figure(
        figsize=(3.2 * len(fields) + 0.8, (3.2 * size[1] / size[0] + 0.2) * len(heights) + 0.3),
        layout="constrained",
    )
    axes = figure.subplots(len(heights), len(fields), squeeze=False, sharex=True, sharey=True)
    for row, height in zip(axes, heights, strict=True):
        for ax, (title, field) in zip(row, fields.items(), strict=True):
            image = draw_slice(
                ax,
                field,
                height,
                np.array([0.0, 0.0, 1.0]),
                poses,
                keyframes.get(title),
                spacing=0.03,
                bounds=bounds,
                grey_unknown=title not in predictive,
            )
            ax.set_title(title if ax in axes[0] else "", fontsize=16)
        row[0].set_ylabel(f"height {height:.2f} m", fontsize=14)
    figure.colorbar(image, ax=axes, label="signed distance [m]", shrink=0.8)
    save_small(figure, path, dpi)


def save_picture_row(
    path: str | Path, pictures: Mapping[str, Float[np.ndarray, "h w"]], dpi: int = 60
) -> None:
    """Grey pictures (0 black, 1 white) side by side, each under its title."""
    height, width = next(iter(pictures.values())).shape
    figure = Figure(figsize=(3.6 * len(pictures), 3.6 * height / width + 0.6), layout="constrained")
    axes = figure.subplots(1, len(pictures), squeeze=False)[0]
    for ax, (title, picture) in zip(axes, pictures.items(), strict=True):
        ax.imshow(picture, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title, fontsize=14)
        ax.set_axis_off()
    save_small(figure, path, dpi)


def save_small(figure: Figure, path: str | Path, dpi: int) -> None:
    """Write a figure as a PNG with a palette, a quarter of the size of one with full colours."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=dpi, format="png")
    picture = (
        Image.open(buffer)
        .convert("RGB")
        .quantize(PALETTE, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    )
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    picture.save(path, optimize=True)
