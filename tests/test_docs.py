"""README and documentation tell the truth: their code runs, and the files and commands they name exist.

A page is followed from its top in an empty folder, its Python blocks in one namespace. A comment before a block says
what else a reader has by then, or that the block takes long:

    <!-- before: NAME -->   tests/docs_material.py makes what the block needs
    <!-- slow -->           runs with the slow tests only; <!-- slow: NAME --> makes what it would have left meanwhile
    <!-- clone -->          runs in a fresh clone with an environment of its own, with the slow tests only
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests import docs_material

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHOWN = {"text", "json", "yaml"}
"""Languages of blocks that are not for running."""
NIGHTS = "docs/results.md"
"""Its commands repeat the experiments, for a night and more; the tests of benchmarks/ cover them."""


@dataclass(frozen=True)
class Block:
    """One fenced block: its language, text, line, and what the comment before it says."""

    language: str
    text: str
    line: int
    rule: str
    material: str | None


def blocks_of(page: Path) -> list[Block]:
    """The fenced blocks of a page."""
    text, found = page.read_text(), []
    pattern = r"(?:<!-- (before|slow|clone)(?:: (\w+))? -->\n)?^ *```(\w*)\n(.*?)^ *```$"
    for match in re.finditer(pattern, text, flags=re.DOTALL | re.MULTILINE):
        rule, material, language, body = match.groups()
        line = text.count("\n", 0, match.start(4)) + 1
        found.append(Block(language, body, line, rule or "", material))
    return found


BLOCKS = {
    page.relative_to(ROOT).as_posix(): blocks_of(page)
    for page in PAGES
    if page.relative_to(ROOT).as_posix() != NIGHTS
}
WITH_CODE = [page for page, blocks in BLOCKS.items() if any(b.language in ("python", "sh") for b in blocks)]


class Reader:
    """Follows a page in a folder, the long blocks only where asked to."""

    def __init__(self, page: str, folder: Path, patiently: bool) -> None:
        self.page, self.folder, self.patiently = page, folder, patiently
        self.names: dict = {"__name__": "page"}
        self.done = 0
        # The folder looks like a clone, so that `python -m examples.record` is found.
        for name in ("isdf", "planning", "robots", "examples", "benchmarks", "tests", "docs"):
            (folder / name).symlink_to(ROOT / name)

    def follow(self) -> None:
        """Run every block in order."""
        for block in BLOCKS[self.page]:
            long = block.rule in ("slow", "clone")
            if block.material and (block.rule == "before" or not self.patiently):
                getattr(docs_material, block.material)(self.folder)
            if block.language in SHOWN or block.rule == "clone" or (long and not self.patiently):
                continue
            self.done += 1
            if block.language == "python":
                code = "\n" * (block.line - 1) + block.text
                exec(compile(code, str(ROOT / self.page), "exec"), self.names)
            else:
                self.shell(block)

    def shell(self, block: Block) -> None:
        """Commands as a reader types them; where time is short, this project's own are called instead of started."""
        for line in block.text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if not self.patiently and words and words[0] in ("isdf", "robots"):
                call(words)
                continue
            path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
            environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "CI": "true"}
            text = block.text if self.patiently else line
            outcome = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", text],
                cwd=self.folder,
                env=environment,
                capture_output=True,
                text=True,
            )
            assert outcome.returncode == 0, f"{self.page}:{block.line}: {text}\n{outcome.stderr}"
            if self.patiently:
                return


def call(words: list[str]) -> None:
    """One of the project's commands in this process."""
    import isdf.cli
    import robots.cli

    old, sys.argv = sys.argv, words
    try:
        {"isdf": isdf.cli.main, "robots": robots.cli.main}[words[0]]()
    except SystemExit as ended:
        assert not ended.code, f"{shlex.join(words)} ended with {ended.code}"
    finally:
        sys.argv = old


@pytest.mark.parametrize("page", WITH_CODE)
def test_the_quick_blocks_of_a_page_run(page, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    reader = Reader(page, tmp_path, patiently=False)
    reader.follow()
    assert reader.done or all(b.rule in ("slow", "clone") for b in BLOCKS[page] if b.language not in SHOWN)


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_CODE)
def test_every_block_of_a_page_runs(page, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Reader(page, tmp_path, patiently=True).follow()


@pytest.mark.slow
def test_the_blocks_for_a_fresh_clone_run_in_one(tmp_path) -> None:
    """With an environment of its own, as on a new machine; `make test` only collects."""
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    blocks = [b for page in WITH_CODE for b in BLOCKS[page] if b.rule == "clone"]
    assert blocks
    quiet = {"PYTEST_ADDOPTS": "--collect-only --quiet"}
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV", "MAKEFLAGS")}
    for text in dict.fromkeys(b.text for b in blocks):
        outcome = subprocess.run(["bash", "-euo", "pipefail", "-c", text], cwd=clone, env=environment | quiet)
        assert outcome.returncode == 0, text


def test_every_block_says_what_it_is_and_what_it_needs() -> None:
    assert sum(map(len, BLOCKS.values())) > 20
    for page, blocks in BLOCKS.items():
        assert (ROOT / page).read_text().count("```") == 2 * len(blocks), f"{page}: a fence without its end"
        for block in blocks:
            assert block.language in ("python", "sh", *SHOWN), f"{page}:{block.line}: ```{block.language}"
            assert block.material is None or hasattr(docs_material, block.material), f"{page}:{block.line}"


def test_every_make_target_and_module_it_names_exists() -> None:
    makefile = (ROOT / "Makefile").read_text()
    texts = [page.read_text() for page in PAGES]
    targets = {t for text in texts for t in re.findall(r"^make (\w+)|`make (\w+)", text, flags=re.MULTILINE)}
    modules = {
        m for text in texts for m in re.findall(r"python -m ((?:examples|benchmarks|docs|tests)[\w.]*)", text)
    }
    assert targets and modules
    for target in targets:
        assert re.search(rf"^{target[0] or target[1]}:", makefile, flags=re.MULTILINE), target
    for module in modules:
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module


LINKS = [
    (page, link)
    for page in PAGES
    for link in re.findall(r"\]\((?!http|#)([^)#\s]+)[^)]*\)", page.read_text())
]


@pytest.mark.parametrize(("page", "link"), LINKS, ids=[f"{p.stem}-{n}" for p, n in LINKS])
def test_every_local_link_and_picture_exists(page, link) -> None:
    assert (page.parent / link).exists()


def test_the_pictures_of_the_concepts_are_drawn_by_the_code_of_today(tmp_path) -> None:
    """By their own command: drawing sets the number of threads of its whole process."""
    run = [sys.executable, "-m", "docs.pictures", "--out", str(tmp_path)]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shown = {path.name for path in (ROOT / "docs/images/concepts").iterdir()}
    assert {path.name for path in tmp_path.iterdir()} == shown
