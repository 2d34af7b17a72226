"""The report of an episode as a page: verdict, figures and pictures."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:1100px;margin:2rem auto;padding:0 1rem;color:#222}"
    "img{max-width:100%}table{border-collapse:collapse}td{padding:.15rem 1rem .15rem 0;vertical-align:top}"
    ".good{color:#0a7d32}.bad{color:#b3261e}"
)


def write_report(out: Path, report: dict[str, Any], headline: str) -> None:
    """Write report.json and report.html, with whatever pictures the folder holds.

    Args:
        out: the episode's folder.
        report: plain values; `success` decides the colour of the verdict.
        headline: one line that says what happened.
    """
    (out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    rows = "".join(
        f"<tr><td>{html.escape(key)}</td><td>{html.escape(value)}</td></tr>" for key, value in _flat(report)
    )
    pictures = "".join(
        f'<h2>{title}</h2><img src="{name}" alt="{title}">'
        for name, title in (
            ("summary.png", "In one picture"),
            ("episode.gif", "The episode"),
            ("map.png", "The map and the way"),
        )
        if (out / name).exists()
    )
    verdict = "good" if report["success"] else "bad"
    title = f"{report['example']}: {report['scene']}, seed {report['seed']}"
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1>"
        f'<p class="{verdict}"><strong>{html.escape(headline)}</strong></p>{pictures}'
        f"<h2>Figures</h2><table>{rows}</table></html>\n"
    )
    (out / "report.html").write_text(page)


def _flat(values: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested values as rows; times and lengths to three digits."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, dict):
            rows += _flat(value, f"{prefix}{key} / ") or [(f"{prefix}{key}", "none")]
        else:
            rows.append((f"{prefix}{key}", f"{value:.3f}" if isinstance(value, float) else str(value)))
    return rows
