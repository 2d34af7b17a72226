"""A headless Chromium for tests of pages: found on this machine or the test is skipped, drawing in software."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SIZE = {"width": 760, "height": 420}
HARMLESS = ("deprecated", "GPU stall", "favicon")
"""What a console says in every page of viser's."""


@contextmanager
def page_of(url: str) -> Iterator[tuple[Any, list[str]]]:
    """A page that has drawn something, and the errors on its console."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed (apt-get install chromium)")
    with sync_api.sync_playwright() as playwright:
        # A machine that has much else to do is slow to draw in software.
        browser = playwright.chromium.launch(executable_path=found, args=list(FLAGS))
        page, errors = browser.new_page(viewport=SIZE), []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda said: _note(said, errors))
        page.goto(url)
        page.wait_for_selector("canvas", timeout=60_000)
        yield page, errors
        browser.close()


def _note(said: Any, errors: list[str]) -> None:
    if said.type == "error" and not any(word in said.text for word in HARMLESS):
        errors.append(said.text)


def wait(page: Any, true: Any, seconds: float = 60.0) -> None:
    """Let the page go on until something is true."""
    for _ in range(round(seconds / 0.1)):
        if true():
            return
        page.wait_for_timeout(100)
    raise AssertionError("it did not happen in time")


def colours_of(page: Any) -> int:
    """How many colours the scene's part of the page shows."""
    import io

    from PIL import Image

    box = page.locator("canvas").first.bounding_box()
    with Image.open(io.BytesIO(page.screenshot(clip=box, timeout=60_000))) as picture:
        return len(picture.convert("RGB").getcolors(1 << 22))


def on_screen(viewer: Any, page: Any, point: np.ndarray) -> tuple[float, float]:
    """Where a world point (3,) [m] is in the page [px]."""
    from viser import transforms

    (client,) = viewer.server.get_clients().values()
    camera, box = client.camera, page.locator("canvas").first.bounding_box()
    x, y, z = transforms.SO3(camera.wxyz).as_matrix().T @ (np.asarray(point) - camera.position)
    focal = box["height"] / 2 / np.tan(camera.fov / 2)
    return box["x"] + box["width"] / 2 + focal * x / z, box["y"] + box["height"] / 2 + focal * y / z


def drag(page: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    """With the mouse."""
    page.mouse.move(*start)
    page.wait_for_timeout(300)  # until what is under the mouse has been looked up
    page.mouse.down()
    for share in (0.2, 0.4, 0.6, 0.8, 1.0):
        page.mouse.move(*(np.array(start) + share * (np.array(end) - np.array(start))))
        page.wait_for_timeout(50)
    page.mouse.up()
