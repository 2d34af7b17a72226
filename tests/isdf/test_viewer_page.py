"""The viewer's page in a headless Chromium: it loads, and its slider and buttons do what they say."""

from __future__ import annotations

import pytest

from isdf.viewer import Viewer
from tests.browser import colours_of, page_of, wait
from tests.isdf.test_viewer import Ball, full_state

pytest.importorskip("viser")


def test_the_page_shows_the_map_and_its_controls_reach_the_program() -> None:
    ball = Ball()
    with Viewer(0) as viewer, page_of(viewer.url) as (page, errors):
        wait(page, lambda: viewer.watched)
        viewer.show(lambda: full_state(1.0, ball))
        wait(page, lambda: viewer.stage.slice is not None and "surface/map" in viewer.stage._handles)
        page.get_by_text("t = 1.0 s").wait_for()
        wait(page, lambda: colours_of(page) > 500)

        slider = page.get_by_role("slider").first
        before = viewer.stage.slice
        slider.focus()
        for _ in range(5):
            slider.press("ArrowRight")
        wait(page, lambda: viewer.stage.slice.centre[2] > before.centre[2] + 0.09)
        assert (viewer.stage.slice.image != before.image).any()
        assert viewer.panel.height == pytest.approx(viewer.stage.slice.centre[2])

        distances = viewer.stage.slice
        page.get_by_role("textbox", name="Colours").or_(page.locator("input[value='distance']")).first.click()
        page.get_by_role("option", name="confidence").click()
        wait(page, lambda: viewer.stage.slice is not distances)
        assert viewer.panel.quantity == "confidence"

        page.get_by_text("Pause", exact=True).click()
        wait(page, lambda: viewer.controls.paused)
        assert not viewer.controls.may_go()
        page.get_by_text("Step", exact=True).click()
        wait(page, viewer.controls.may_go)
        assert not viewer.controls.may_go(), "one step"
        page.get_by_text("Play", exact=True).click()
        wait(page, lambda: not viewer.controls.paused)
        assert not errors, errors
    assert not viewer.watched
