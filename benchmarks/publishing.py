"""Tables and pictures go to their marked places in a Markdown page."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path


def publish(page: Path, parts: Mapping[str, str], pictures: Sequence[Path]) -> None:
    """Put tables between their marks in the page, and the pictures it shows into images/results beside it.

    Args:
        page: a Markdown file with marks `<!-- NAME -->` and `<!-- /NAME -->`; what has none is left out.
        parts: name -> Markdown.
        pictures: files; those that the page shows are copied.
    """
    text = page.read_text()
    for name, table in parts.items():
        marked = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- /{re.escape(name)} -->)", re.DOTALL)
        text = marked.sub(lambda found, table=table: f"{found[1]}\n{table}\n{found[2]}", text)
    page.write_text(text)
    folder = page.parent / "images" / "results"
    folder.mkdir(parents=True, exist_ok=True)
    for picture in pictures:
        if f"images/results/{picture.name}" in text:
            shutil.copy(picture, folder / picture.name)
