"""Pictures of a closed-loop episode: the map with plan and path, and a short film."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from examples.episode import Episode, base_outline, outline_at
from isdf.slices import draw_slice
from planning.protocols import DistanceField
from robots.simulation import World

SLICE_HEIGHT = 0.5
COLOUR_LIMIT = 1.0
NEAR = 0.08
"""Distance at which the colours of the finer map end [m]."""
ROUND_OBJECT = 0.15
"""Of the map round an object that much is drawn to all sides [m]."""


class Film:
    """Collects frames of an episode and writes them as a GIF.

    Args:
        episode: what is filmed.
        goal: x, y [m] to mark.
        least_gap: simulated seconds between two frames.
    """

    def __init__(self, episode: Episode, goal: np.ndarray, least_gap: float = 1.0) -> None:
        self.episode, self.goal, self.least_gap = episode, goal, least_gap
        self.close_up: np.ndarray | None = None
        """A point [m] to look at from near instead of the whole room."""
        self.close_map: DistanceField | None = None
        """A finer map round that point, drawn in place of the whole map."""
        self.tool_way: np.ndarray | None = None
        """Where the hand is to go (n, 3) [m]."""
        self._frames: list[Image.Image] = []
        self._last = -np.inf

    def add(self, plan: np.ndarray | None = None) -> None:
        """Take a frame now if the last one is old enough; `plan` is (n, 2) positions [m]."""
        robot = self.episode.robot
        if robot.time - self._last < self.least_gap or self.episode.mapper.frames_seen == 0:
            return
        self._last = robot.time
        figure = Figure(figsize=(9.6, 3.9), layout="constrained")
        left, right = figure.subplots(1, 2)
        if self.close_up is not None and self.close_map is not None:
            cut = outline_at(self.episode.model, robot.posture(), float(self.close_up[2]))
            draw_grasp(left, self.close_map, self.close_up, self.tool_way, cut)
            left.set_title(f"finer map at {self.close_up[2]:.2f} m, t = {robot.time:.0f} s")
        else:
            draw_map(left, self.episode, plan, self.goal, spacing=0.08)
            left.set_title(f"map at {SLICE_HEIGHT} m, t = {robot.time:.0f} s")
        right.imshow(photo(self.episode, close_up=self.close_up))
        right.set_axis_off()
        self._frames.append(_rendered(figure))

    def frame(self, frame: Any) -> Any:
        """The robot's image as it is: a film may sit beside the robot as a disturbance that changes nothing."""
        return frame

    def advance(self, robot: Any, duration: float) -> None:
        """Film what the robot does between its stages, too."""
        self.add()

    def save(self, path: Path) -> None:
        """Write the GIF, at most 60 frames of it."""
        frames = self._frames[:: -(-len(self._frames) // 60) or 1]
        if frames:
            small = [f.quantize(192, Image.Quantize.MAXCOVERAGE) for f in frames]
            small[0].save(path, save_all=True, append_images=small[1:], duration=180, loop=0, optimize=True)


def save_map_picture(path: Path, episode: Episode, goal: np.ndarray) -> None:
    """The learned slice, the true one where it is known, each with the driven path; and the room from above."""
    truths = (False, True) if episode.world.solids else (False,)
    figure = Figure(figsize=(5 * len(truths) + 5, 4), layout="constrained")
    *maps, room = figure.subplots(1, len(truths) + 1)
    for axes, truth in zip(maps, truths, strict=True):
        image = draw_map(axes, episode, None, goal, truth=truth)
        axes.set_title("ground truth" if truth else f"learned signed distance at {SLICE_HEIGHT} m")
    figure.colorbar(image, ax=maps, label="[m]", shrink=0.8)
    room.imshow(photo(episode, 960, 720))
    room.set_axis_off()
    figure.savefig(path, dpi=110)


def draw_map(axes, episode: Episode, plan, goal, spacing: float = 0.03, truth: bool = False):
    """One slice of the map with the robot, its way so far (red), its plan (green) and the goal (star)."""
    (x0, y0), (x1, y1) = region(episode)
    xs, ys = np.arange(x0, x1, spacing), np.arange(y0, y1, spacing)
    points = np.stack([*np.meshgrid(xs, ys), np.full((len(ys), len(xs)), SLICE_HEIGHT)], axis=-1)
    field = episode.world.field() if truth else episode.mapper.field()
    distance = field.distance(torch.from_numpy(points.astype(np.float32))).numpy()
    image = axes.imshow(
        distance,
        origin="lower",
        extent=(x0, x1, y0, y1),
        cmap="coolwarm_r",
        vmin=-COLOUR_LIMIT,
        vmax=COLOUR_LIMIT,
    )
    axes.contour(xs, ys, distance, levels=[0.0], colors="black", linewidths=1.0)
    for x, y, radius in base_outline(episode.model, episode.robot.posture()):
        axes.add_patch(_disc(x, y, radius))
    driven = episode.robot.recording.base_poses()
    axes.plot(driven[:, 0], driven[:, 1], color="red", linewidth=1.5)
    if plan is not None:
        axes.plot(plan[:, 0], plan[:, 1], color="limegreen", linewidth=1.5)
    axes.plot(*goal[:2], "*", color="gold", markersize=14, markeredgecolor="black")
    axes.set_aspect("equal")
    return image


def draw_grasp(
    axes,
    close: DistanceField,
    point: np.ndarray,
    tool_way: np.ndarray | None,
    hand: Sequence[np.ndarray] = (),
) -> None:
    """The finer map at the height of the point from above, the way of the hand to it, and discs (n, 3) of the robot."""
    around = torch.as_tensor(np.stack([point - ROUND_OBJECT, point + ROUND_OBJECT]), dtype=torch.float32)
    image = draw_slice(axes, close, float(point[2]), np.array([0.0, 0.0, 1.0]), spacing=0.003, bounds=around)
    image.set_clim(-NEAR, NEAR)
    axes.plot(*point[:2], "+", color="black", markersize=12)
    if tool_way is not None:
        axes.plot(tool_way[:, 0], tool_way[:, 1], color="purple", linewidth=2.0)
        axes.plot(*tool_way[-1, :2], "o", color="purple")
    for x, y, radius in hand:
        axes.add_patch(_disc(x, y, radius))
    axes.set_xlim(point[0] - ROUND_OBJECT, point[0] + ROUND_OBJECT)
    axes.set_ylim(point[1] - ROUND_OBJECT, point[1] + ROUND_OBJECT)
    axes.set_title(
        f"finer map at {point[2]:.2f} m, {'hand (purple)' if tool_way is not None else 'no grasp'}"
    )


def region(episode: Episode) -> np.ndarray:
    """Lower and upper corner (2, 2) [m] of the room, or of what has been seen of it."""
    if episode.scene.size is None:
        return episode.mapper.bounds[:, :2].numpy()
    half = np.array(episode.scene.size[:2]) / 2 + 0.1
    return np.stack([-half, half])


def photo(
    episode: Episode, width: int = 480, height: int = 360, close_up: np.ndarray | None = None
) -> np.ndarray:
    """The room from obliquely above, or a point of it from near: (height, width, 3) uint8."""
    if close_up is None:
        low, high = region(episode)
        target, span = np.array([*(low + high) / 2, 0.3]), float((high - low).max())
        eye = target + np.array([0.0, -0.45 * span, 1.05 * span])
    else:
        # From beside the robot, whose back would hide what it does.
        yaw = float(episode.robot.base_state()[2])
        forward, left = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
        target = close_up
        eye = target - 0.5 * forward + 1.3 * left + np.array([0.0, 0.0, 0.7])
    if "ceiling" in episode.world.solids:
        # Seen through from above; the depth camera, which draws no colours, still sees it.
        ceiling = episode.world.body_id("ceiling")
        pybullet.changeVisualShape(ceiling, -1, rgbaColor=[1, 1, 1, 0], physicsClientId=episode.world.client)
    return photo_from(episode.world, eye, target, width, height)


def photo_from(world: World, eye: np.ndarray, target: np.ndarray, width: int, height: int) -> np.ndarray:
    """What a camera at `eye` that looks at `target` [m] sees: (height, width, 3) uint8."""
    view = pybullet.computeViewMatrix(eye.tolist(), target.tolist(), [0, 0, 1])
    projection = pybullet.computeProjectionMatrixFOV(50, width / height, 0.1, 60)
    shown = pybullet.getCameraImage(
        width,
        height,
        view,
        projection,
        lightDirection=[2, -3, 6],
        flags=pybullet.ER_NO_SEGMENTATION_MASK,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=world.client,
    )
    return np.reshape(shown[2], (height, width, 4))[:, :, :3].astype(np.uint8)


def _disc(x: float, y: float, radius: float):
    from matplotlib.patches import Circle

    return Circle((x, y), radius, facecolor="orange", edgecolor="none", alpha=0.6, zorder=5)


def _rendered(figure: Figure) -> Image.Image:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
