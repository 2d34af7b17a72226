"""The viewer's side panel: status, play and pause, goal, slice, layers, the camera's image, moments of a replay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .controls import Controls
from .pictures import Quantity, depth_picture
from .state import ViewState, layer_of

LAYERS = ("map", "slice", "camera")


class Panel:
    """Widgets in a viser side panel. What it changes it tells by `changed` and `set_visible`.

    Args:
        server: a `viser.ViserServer`.
        controls: of the program that is watched.
        set_visible: called with a layer and whether to show it.
        goal_moves: whether a goal may be changed.
    """

    def __init__(
        self, server: Any, controls: Controls, set_visible: Callable[[str, bool], None], goal_moves: bool
    ) -> None:
        self._gui, self._controls, self._set_visible = server.gui, controls, set_visible
        self.changed = False
        """Whether the slice has to be drawn anew; whoever draws it sets this back."""
        self.status = self._gui.add_markdown("waiting for the first image")
        self._add_flow()
        self._goal_folder = self._gui.add_folder("Goal", visible=False)
        self._add_slice()
        self._goal_moves = goal_moves
        self.goal: Any = None
        self._told: tuple[float, ...] = ()
        self._shown = self._gui.add_folder("Show")
        self._boxes: dict[str, Any] = {}
        for layer in LAYERS:
            self.add_layer(layer)
        self._image: Any = None
        self._frame: Any = None
        self.moment: Any = None

    @property
    def quantity(self) -> Quantity:
        """What the slice's colours say."""
        return self._quantity.value

    @property
    def fade(self) -> bool:
        """Whether the slice is fainter where the map is less sure."""
        return bool(self._fade.value)

    @property
    def height(self) -> float:
        """Of the slice, along up [m]."""
        return float(self.slider.value)

    def set_range(self, low: float, high: float) -> None:
        """The slice may be moved between two heights [m]."""
        low, high = np.floor(20 * low) / 20, np.ceil(20 * high) / 20
        if (low, high) != (self.slider.min, self.slider.max):
            value = float(np.clip(self.slider.value, low, high))
            self.slider.min, self.slider.max = min(low, self.slider.min), max(high, self.slider.max)
            self.slider.value = value
            self.slider.min, self.slider.max = low, high

    def show(self, state: ViewState) -> None:
        """Bring status, image, goal and the list of layers up to date."""
        text = f"**t = {state.time:.1f} s**" + (f"  \n{state.status}" if state.status else "")
        if self.status.content != text:
            self.status.content = text
        for name in [*state.shapes, *state.spheres, *state.lines]:
            self.add_layer(layer_of(name))
        if state.frame is not None and state.frame is not self._frame:
            self._frame = state.frame
            picture = depth_picture(state.frame.depth)
            if self._image is None:
                self._image = self._gui.add_image(picture, label="Depth image", format="jpeg")
            else:
                self._image.image = picture
        if state.goal is not None and self._goal_moves:
            self._tell_goal(tuple(round(float(v), 2) for v in state.goal))

    def add_layer(self, layer: str) -> None:
        """A box to show and hide a layer, if there is none yet."""
        if layer in self._boxes:
            return
        with self._shown:
            box = self._boxes[layer] = self._gui.add_checkbox(layer, True)
        box.on_update(lambda _: self._set_visible(layer, bool(box.value)))

    def add_moments(self, count: int, seconds: float, chosen: Callable[[int], None]) -> None:
        """A slider over the states of a recording; `chosen` is called when somebody moves it."""
        label = f"Moment, of {count} in {seconds:.0f} s"
        self.moment = self._gui.add_slider(label, 0, max(1, count - 1), 1, 0)
        self.moment.on_update(lambda event: chosen(int(self.moment.value)) if event.client else None)

    def _add_flow(self) -> None:
        row = self._gui.add_button_group("Time", ("Play", "Pause", "Step"))

        @row.on_click
        def _(_: Any) -> None:
            {"Play": self._controls.play, "Pause": self._controls.pause, "Step": self._controls.step}[
                row.value
            ]()

    def _add_slice(self) -> None:
        with self._gui.add_folder("Slice"):
            self.slider = self._gui.add_slider("Height [m]", 0.0, 2.0, 0.02, 0.5)
            self._quantity = self._gui.add_dropdown("Colours", ("distance", "confidence"))
            self._fade = self._gui.add_checkbox("Fade where unsure", True)
        for widget in (self.slider, self._quantity, self._fade):
            widget.on_update(lambda _: self._touch())

    def _touch(self) -> None:
        self.changed = True

    def _tell_goal(self, at: tuple[float, ...]) -> None:
        """Say where the goal is, with a widget to type another."""
        if self.goal is None:
            add, label = (
                (self._gui.add_vector2, "x, y [m]")
                if len(at) == 2
                else (self._gui.add_vector3, "x, y, z [m]")
            )
            self._goal_folder.visible = True
            with self._goal_folder:
                self._gui.add_markdown("Drag it by its arrows, or type.")
                self.goal = add(label, at, step=0.01)
            self.goal.on_update(self._goal_typed)
        elif self._told != at:
            self.goal.value = at
        self._told = at

    def _goal_typed(self, event: Any) -> None:
        if event.client is not None:  # typed, not told
            self._told = tuple(self.goal.value)
            self._controls.move_goal(np.array(self._told))
