"""An episode as one picture: the map with the ways, the truth, clearance or lift over time, what happened in a line."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from examples.episode import Episode
from examples.pictures import draw_grasp, draw_map
from isdf.viewer.pictures import depth_picture
from planning.protocols import DistanceField
from robots.simulation import DepthFrame, SceneField

MOMENTS = 150
"""At most so many postures of an episode are looked at."""
LEAST = 0.05
"""Clearance under which a way is called close [m]."""


def drive_summary(
    path: Path, episode: Episode, goal: np.ndarray, plan: np.ndarray | None, headline: str
) -> None:
    """Map and truth with the last plan and the way, and how near the robot came to things.

    Args:
        path: of the picture.
        episode: when it is over; its states are taken from its recording.
        goal: x, y [m].
        plan: (n, 2) of the last plan [m].
        headline: what happened, in a line.
    """
    truth = _truth_without_floor(episode)
    figure, axes = _begun(headline, 2 + (truth is not None))
    image = draw_map(axes[0], episode, plan, goal)
    axes[0].set_title("the map, the last plan (green), the way (red)")
    figure.colorbar(image, ax=axes[0], label="signed distance [m]", shrink=0.7)
    if truth is not None:
        draw_map(axes[1], episode, None, goal, truth=True)
        axes[1].set_title("the truth")
    draw_clearance(axes[-1], episode, truth)
    figure.savefig(path, dpi=100)


def grasp_summary(
    path: Path,
    episode: Episode,
    point: np.ndarray,
    name: str,
    looked: tuple[DistanceField, DepthFrame] | None,
    tool_way: np.ndarray | None,
    headline: str,
) -> None:
    """The drive, the clicked point in the camera's image, the grasp in the finer map, and how high the object went.

    Args:
        path: of the picture.
        episode: when it is over.
        point: that was clicked [m].
        name: of the object.
        looked: the finer map and the image it ends with; None if it never came to that.
        tool_way: (n, 3) of the hand on its last straight line to the object [m]; None where no grasp was chosen.
        headline: what happened, in a line.
    """
    figure, axes = _begun(headline, 2 if looked is None else 4)
    draw_map(axes[0], episode, None, point)
    axes[0].set_title("the map and the way")
    if looked is not None:
        draw_click(axes[1], looked[1], point)
        draw_grasp(axes[2], looked[0], point, tool_way)
    draw_lift(axes[-1], episode, name)
    figure.savefig(path, dpi=100)


def draw_clearance(axes: Axes, episode: Episode, truth: SceneField | None) -> None:
    """Least distance of the robot's spheres from things over time: in truth but for the floor, else in the last map."""
    recording = episode.robot.recording
    times, postures = recording.postures()
    some = slice(None, None, max(1, len(times) // MOMENTS))
    centres, radii = episode.model.spheres(torch.as_tensor(postures[some], dtype=torch.float32))
    off_floor = ~episode.model.floor_spheres
    centres, radii, times = centres[:, off_floor], radii[off_floor], times[some]
    if truth is None:
        field, label = episode.mapper.field(), "in the last map"
        clear = (field.distance(centres) - radii).amin(dim=1).numpy()
    else:
        label = "in truth"
        clear = clearances(truth, centres, radii, recording.movers, recording.object_poses()[some])
    axes.plot(times, 100 * clear, label=f"{label}: least {100 * clear.min():.0f} cm")
    axes.axhline(0.0, color="black", linewidth=1.0)
    axes.axhspan(0.0, 100 * LEAST, color="0.9")
    axes.set(xlabel="time [s]", ylabel="clearance [cm]", title="how near the robot came to things")
    axes.set_ylim(bottom=min(-2.0, axes.get_ylim()[0]))
    axes.legend(fontsize=8)


def clearances(
    truth: SceneField,
    centres: Float[Tensor, "n s 3"],
    radii: Float[Tensor, " s"],
    movers: Sequence[str],
    poses: Float[np.ndarray, "n k 4 4"],
) -> Float[np.ndarray, " n"]:
    """Least distance [m] of spheres from what is in a scene, at each moment from movers where they were then.

    Args:
        truth: the scene.
        centres: of the spheres at each moment [m].
        radii: [m].
        movers: names of what moved; those that are not in the scene do not count.
        poses: of the movers at each moment, NaN while they were not there.
    """
    moving = {name for name in movers if name in truth.names}
    clear = torch.full((len(centres),), torch.inf)
    if set(truth.names) - moving:
        clear = (truth.without(moving).distance(centres) - radii).amin(dim=1)
    for n, now in enumerate(poses):
        there = {
            name: pose
            for name, pose in zip(movers, now, strict=True)
            if name in moving and np.isfinite(pose).all()
        }
        if there:
            field = truth.without(set(truth.names) - set(there)).at_poses(there)
            clear[n] = torch.minimum(clear[n], (field.distance(centres[n]) - radii).amin())
    return clear.numpy()


def draw_click(axes: Axes, frame: DepthFrame, point: np.ndarray) -> None:
    """A depth image with a point [m] marked."""
    x, y, z = np.linalg.inv(frame.T_world_camera)[:3] @ np.array([*point, 1.0])
    camera = frame.camera
    axes.imshow(depth_picture(frame.depth, farthest=2.5, width=camera.width))
    axes.plot(
        camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z, "c+", markersize=18, markeredgewidth=2.5
    )
    axes.set_title("depth image with the clicked point")
    axes.set_axis_off()


def draw_lift(axes: Axes, episode: Episode, name: str) -> None:
    """How high an object is over where it was, over time."""
    times, heights = episode.robot.recording.heights(name)
    lifted = 100 * (heights - heights[0])
    axes.plot(times, lifted)
    axes.axhline(10.0, color="0.6", linestyle="--", linewidth=1.0)
    axes.set(
        xlabel="time [s]",
        ylabel="object over its place [cm]",
        title=f"lifted by at most {lifted.max():.0f} cm",
    )


def _begun(headline: str, panels: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(5.2 * panels, 4.6), layout="constrained")
    figure.suptitle("\n".join(textwrap.wrap(headline, 45 * panels)), fontsize=12)
    return figure, list(figure.subplots(1, panels))


def _truth_without_floor(episode: Episode) -> SceneField | None:
    if not episode.world.solids or episode.scene.urdf_path is not None:
        return None
    field = episode.world.field()
    return field.without({"floor"} & set(field.names))
