"""The three-dimensional part of the viewer: puts a state into the browser's scene, and only what has changed of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from .pictures import Slice, depth_picture
from .state import Line, Shape, Spheres, ViewState, layer_of

FRUSTUM = 0.25
"""Size of the camera's pyramid [m]."""
GOAL_COLOUR, GOAL_POST = (250, 200, 30), 0.9
"""A ball on a post [m] that is seen from afar; a goal in space is a small ball."""
SURFACE = "map"


class Stage:
    """Named things in a viser scene.

    Args:
        server: a `viser.ViserServer`.
        up: unit vector.
        on_goal: called with the goal [m] when somebody has dragged it; None if it cannot be dragged.
    """

    def __init__(
        self, server: Any, up: Float[np.ndarray, "3"], on_goal: Callable[[np.ndarray], None] | None
    ) -> None:
        from viser import transforms

        self._so3 = transforms.SO3
        self._scene, self._on_goal = server.scene, on_goal
        self._scene.set_up_direction(tuple(up.tolist()))
        self._drawn: dict[str, Any] = {}  # what a handle shows
        self._handles: dict[str, Any] = {}
        self._hidden: set[str] = set()
        self._dragging = False
        self.slice: Slice | None = None
        """What was drawn last."""

    def draw(self, state: ViewState) -> None:
        """Show a state in place of the last one; slice and surface stay."""
        wanted = {f"{kind}/{name}": thing for kind, things in _kinds(state) for name, thing in things.items()}
        for name, thing in wanted.items():
            if self._drawn.get(name) is not thing:
                self._put(name, thing)
            if isinstance(thing, Shape):
                self._place(name, state.poses.get(name.partition("/")[2]))
        for name in [n for n in self._drawn if n not in wanted and n.partition("/")[0] in _KINDS]:
            self._remove(name)
        self._draw_camera(state.frame)
        self._draw_goal(state.goal)

    def draw_surface(self, surface: Shape) -> None:
        """Show the zero level of the map."""
        self._put(f"surface/{SURFACE}", surface)

    def draw_slice(self, shown: Slice) -> None:
        """Show a slice of the map in place of the last one."""
        right, back, normal = shown.axes
        # viser draws an image with its first row at -y, seen from -z.
        rotation = np.stack([right, -back, -normal], axis=1)
        picture = self._handles.get("slice")
        if picture is not None and shown.size == (picture.render_width, picture.render_height):
            picture.image = shown.image
            picture.position = shown.centre
            self.slice = shown
            return
        self._handles["slice"] = self._scene.add_image(
            "/slice", shown.image, *shown.size, format="png", position=shown.centre, cast_shadow=False,
            receive_shadow=False, wxyz=self._so3.from_matrix(rotation).wxyz, visible="slice" not in self._hidden,
        )  # fmt: skip
        self.slice = shown

    def set_visible(self, layer: str, visible: bool) -> None:
        """Show or hide a layer."""
        (self._hidden.discard if visible else self._hidden.add)(layer)
        for name, handle in self._handles.items():
            if _layer(name) == layer:
                handle.visible = visible

    def _put(self, name: str, thing: Shape | Spheres | Line) -> None:
        if self._unchanged(self._handles.get(name), self._drawn.get(name), thing):
            self._drawn[name] = thing
            return
        # A thing added under the name of another takes its place without a flicker.
        handle = self._added(f"/{name}", thing)
        if handle is None:
            self._remove(name)
        else:
            handle.visible = _layer(name) not in self._hidden
            self._handles[name] = handle
        self._drawn[name] = thing

    def _unchanged(self, handle: Any, old: Any, new: Shape | Spheres | Line) -> bool:
        """Whether what is drawn is like the new thing, or could be moved to be."""
        if handle is None:
            return False
        if isinstance(old, Line) and isinstance(new, Line):
            return old.colour == new.colour and np.array_equal(old.points, new.points)
        if isinstance(old, Spheres) and isinstance(new, Spheres) and len(old.radii) == len(new.radii):
            handle.batched_positions, handle.batched_scales = new.centres, new.radii
            return True
        return False

    def _added(self, path: str, thing: Shape | Spheres | Line) -> Any:
        scene = self._scene
        if isinstance(thing, Line):
            if len(thing.points) < 2:
                return None
            return scene.add_line_segments(path, _segments(thing), thing.colour, thickness=thing.width)
        if isinstance(thing, Spheres):
            import trimesh

            ball = trimesh.creation.icosphere(subdivisions=2)
            turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(thing.radii), 1))
            return scene.add_batched_meshes_simple(
                path, ball.vertices, ball.faces, turns, thing.centres, batched_scales=thing.radii,
                batched_colors=thing.colour, opacity=thing.opacity, cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        if len(thing.faces) == 0:
            return None
        # Backs of faces are left out: a room is seen into from outside.
        return scene.add_mesh_simple(
            path, thing.vertices, thing.faces, color=thing.colour, flat_shading=True, side="front",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _place(self, name: str, pose: np.ndarray | None) -> None:
        handle = self._handles.get(name)
        if handle is not None and pose is not None:
            handle.position = pose[:3, 3]
            handle.wxyz = self._so3.from_matrix(pose[:3, :3]).wxyz

    def _remove(self, name: str) -> None:
        self._drawn.pop(name, None)
        handle = self._handles.pop(name, None)
        if handle is not None:
            handle.remove()

    def _draw_camera(self, frame: Any) -> None:
        if frame is None or self._drawn.get("camera") is frame:
            return
        self._drawn["camera"] = frame
        T, camera = np.asarray(frame.T_world_camera, dtype=float), frame.camera
        turn, image = self._so3.from_matrix(T[:3, :3]).wxyz, depth_picture(frame.depth, width=160)
        if "camera" in self._handles:
            handle = self._handles["camera"]
            handle.position, handle.wxyz, handle.image = T[:3, 3], turn, image
            return
        fov = 2 * math.atan2(camera.height / 2, camera.fy)
        self._handles["camera"] = self._scene.add_camera_frustum(
            "/camera", fov, camera.width / camera.height, scale=FRUSTUM, thickness=0.008, color=(30, 60, 160),
            image=image, position=T[:3, 3], wxyz=turn, visible="camera" not in self._hidden,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _draw_goal(self, goal: np.ndarray | None) -> None:
        if goal is None:
            return
        at = np.array([*goal, 0.0])[:3]
        if "goal" in self._handles:
            if not self._dragging and not np.array_equal(at, self._drawn["goal"]):
                self._drawn["goal"] = self._handles["goal"].position = at
            return
        self._drawn["goal"] = at
        in_space = len(goal) == 3
        if self._on_goal is None:
            handle = self._scene.add_frame("/goal", show_axes=False, position=at)
        else:
            handle = self._scene.add_transform_controls(
                "/goal", scale=0.2 if in_space else 0.7, line_width=2.5 if in_space else 4.0, position=at,
                active_axes=(True, True, in_space), disable_rotations=True, depth_test=False,
            )  # fmt: skip
            handle.on_update(lambda event: self._drag(event.phase != "end", len(goal)))
        post = 0.0 if in_space else GOAL_POST
        size = 0.012 if in_space else 0.09
        self._scene.add_icosphere("/goal/ball", size, GOAL_COLOUR, position=(0, 0, post), cast_shadow=False)
        if post:
            line = np.array([[[0, 0, 0], [0, 0, post]]], np.float32)
            self._scene.add_line_segments("/goal/post", line, GOAL_COLOUR, thickness=0.03)
        self._handles["goal"] = handle

    def _drag(self, goes_on: bool, size: int) -> None:
        self._dragging = goes_on
        if not goes_on and self._on_goal is not None:
            self._drawn["goal"] = at = np.array(self._handles["goal"].position)
            self._on_goal(at[:size])


_KINDS = ("shapes", "spheres", "lines")


def _kinds(state: ViewState) -> list[tuple[str, Any]]:
    return [(kind, getattr(state, kind)) for kind in _KINDS]


def _segments(line: Line) -> np.ndarray:
    return np.stack([line.points[:-1], line.points[1:]], axis=1).astype(np.float32)


def _layer(name: str) -> str:
    """Of a handle: "shapes/robot/base" belongs to "robot"."""
    kind, _, rest = name.partition("/")
    return layer_of(rest) if rest else kind
