"""The pictures of docs/concepts.md and docs/design.md, computed by the code that they explain.

python -m docs.pictures
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch

import isdf
import planning
from isdf.bounds import BOUNDS
from isdf.cost import collision_cost
from isdf.mapping.evidence import gather
from isdf.mapping.seeds import surface_seeds
from isdf.sampling import RayBatch
from robots.simulation import Box, DepthCamera, PinholeCamera, SceneField, World, make_scene
from robots.simulation.poses import looking, planar_pose

FOLDER = Path(__file__).parent / "images" / "concepts"
DISTANCES = {"cmap": "coolwarm_r", "vmin": -1.5, "vmax": 1.5}
BLUE, RED, GREEN, GREY = "#1f5f99", "#c0392b", "#1e8449", "0.45"
HEIGHT = 0.4
"""Of the slices [m]."""


@dataclass(frozen=True)
class Pictures:
    """Draw the pictures of the documentation anew."""

    out: Path = FOLDER
    """Folder for the PNG files."""


def slice_points(low: tuple[float, float], high: tuple[float, float], spacing: float = 0.03) -> torch.Tensor:
    """Points (ny, nx, 3) of a horizontal slice [m]."""
    x, y = np.arange(low[0], high[0], spacing), np.arange(low[1], high[1], spacing)
    grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), HEIGHT)], axis=-1)
    return torch.tensor(grid, dtype=torch.float32)


def show(axes: Axes, points: torch.Tensor, values: np.ndarray, **style: object) -> object:
    """A slice as an image in metres."""
    p = points.numpy()
    extent = (p[0, 0, 0], p[0, -1, 0], p[0, 0, 1], p[-1, 0, 1])
    image = axes.imshow(values, origin="lower", extent=extent, **(style or DISTANCES))
    axes.set_aspect("equal")
    return image


def save(figure: Figure, out: Path, name: str) -> None:
    """Write a figure."""
    FigureCanvasAgg(figure)
    figure.savefig(out / f"{name}.png", dpi=110)


def draw_field(out: Path) -> None:
    """The signed distance in a room, and the way it points."""
    field, points = SceneField(make_scene("office", 3)), slice_points((-4.2, -3.2), (4.2, 3.2))
    distance, gradient = field.distance_and_gradient(points)
    figure = Figure(figsize=(8.2, 5.4), layout="constrained")
    axes = figure.subplots()
    image = show(axes, points, distance.numpy())
    p, d, g = points[::9, ::9].numpy(), distance[::9, ::9].numpy(), gradient[::9, ::9].numpy()
    free = d > 0.06
    axes.contour(points[0, :, 0], points[:, 0, 1], distance, levels=[0.0], colors="black", linewidths=1.3)
    axes.quiver(
        p[free, 0], p[free, 1], g[free, 0], g[free, 1], color="0.25", scale=36, width=0.0022, pivot="mid"
    )
    axes.set(xlabel="x [m]", ylabel="y [m]", title=f"An office, {HEIGHT} m above its floor")
    figure.colorbar(image, ax=axes, label="signed distance [m]", shrink=0.85)
    save(figure, out, "field")


def _first_hit(field: SceneField, direction: torch.Tensor) -> torch.Tensor:
    """Distances [m] along rays (n, 3) from the origin to the first surface, by sphere tracing."""
    along = torch.zeros(len(direction), dtype=torch.float64)
    for _ in range(200):
        along += field.distance(along[:, None] * direction)
    return along


def draw_bounds(out: Path) -> None:
    """What a measured depth says about the points in front of it: the three bounds, and the truth."""
    wall = Box("wall", planar_pose(2.6, 0.0, yaw=-0.55), size=(0.6, 5.0, 4.0))
    box = Box("box", planar_pose(1.35, -0.62), size=(0.5, 0.5, 4.0))
    field = SceneField([wall, box])
    angles = torch.linspace(-0.62, 0.62, 60, dtype=torch.float64)
    rays = torch.stack([angles.cos(), angles.sin(), torch.zeros(60, dtype=torch.float64)], dim=-1)
    hits = _first_hit(field, rays)
    ray, length = rays[24:25], hits[24:25]
    along = torch.linspace(0.05, float(length) + 0.1, 200, dtype=torch.float64)[None]
    points = along[..., None] * ray[:, None]
    surface = hits[:, None] * rays
    normal = field.distance_and_gradient(surface[24:25])[1]
    batch = RayBatch(
        points, along, surface[24:25], length, ray, normal, torch.zeros(1, dtype=torch.long), surface
    )
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.15, 1])
    for solid in (wall, box):
        corners = (
            solid.pose[:2, :2] @ (0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * solid.size[:2]).T
        )
        left.fill(*(corners + solid.pose[:2, 3:]), color="0.8", ec="0.5")
    for s in surface[::4].tolist():
        left.plot([0, s[0]], [0, s[1]], color="0.85", lw=0.7, zorder=0)
    left.plot(surface[:, 0], surface[:, 1], ".", color="black", ms=4, label="measured surface points")
    at = 120
    x, end = points[0, at].numpy(), surface[24].numpy()
    nearest = surface[(surface - points[0, at]).norm(dim=-1).argmin()].numpy()
    left.plot([0, end[0]], [0, end[1]], color=GREY, lw=1)
    left.plot([x[0], end[0]], [x[1], end[1]], color=RED, lw=3, label="ray: distance along the ray")
    left.plot([x[0], nearest[0]], [x[1], nearest[1]], color=BLUE, lw=3, label="batch: closest measured point")
    true = float(field.distance(points[0, at : at + 1]))
    left.add_patch(Circle((x[0], x[1]), true, fill=False, ec=GREEN, lw=1.5, ls="--", label="true distance"))
    left.plot(*x[:2], "o", color="black", ms=7)
    left.plot(0, 0, "^", color="black", ms=11)
    left.text(0.05, -0.16, "camera")
    left.set(xlim=(-0.1, 3.0), ylim=(-1.15, 1.25), xlabel="[m]", ylabel="[m]", title="One sample on one ray")
    left.set_aspect("equal")
    left.legend(loc="upper left", fontsize=8)
    for (name, bound), colour in zip(BOUNDS.items(), (RED, "#b9770e", BLUE), strict=True):
        width = 3.5 if name == "ray" else 1.6
        right.plot(along[0], bound(batch)[0][0], color=colour, lw=width, label=f"{name} bound")
    right.plot(along[0], field.distance(points[0]), color=GREEN, ls="--", label="true distance")
    right.axhline(0, color="0.7", lw=0.8)
    right.axvline(along[0, at], color="0.85", lw=1)
    right.set(
        xlabel="distance from the camera along the ray [m]", ylabel="[m]", title="All samples on that ray"
    )
    right.legend()
    save(figure, out, "bounds")


class Disc:
    """A robot that is one disc of 0.2 m on a floor; what every planner here asks of a robot."""

    num_dofs, joint_names = 2, ("x", "y")
    joint_limits, velocity_limits = torch.tensor([[-5.0, 5.0]] * 2), torch.ones(2)

    def spheres(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Its one sphere."""
        centres = torch.cat([q, torch.full_like(q[..., :1], HEIGHT)], dim=-1)
        return centres.unsqueeze(-2), torch.tensor([0.2]).to(q)


def draw_cost(out: Path) -> None:
    """The cost of being near, and a path that descends it."""
    eps = 0.6
    solids = [
        Box("a", planar_pose(-0.5, -0.55, yaw=0.3), size=(0.7, 1.2, 2.0)),
        Box("b", planar_pose(0.75, 0.7), size=(0.6, 0.9, 2.0)),
    ]
    field, points = SceneField(solids), slice_points((-2.2, -1.5), (2.2, 1.6), 0.02)
    line = planning.Trajectory.line(torch.tensor([-1.9, -0.3]), torch.tensor([1.9, 0.3]))
    result = planning.Chomp(Disc(), planning.ChompConfig(eps=eps)).optimise(line, field)
    assert result.success, result.message
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.35])
    s = torch.linspace(-0.5, 1.2, 300)
    cost, slope = collision_cost(s, eps)
    left.plot(s, cost, color=RED, label="cost c(s) [m]")
    left.plot(s, slope, color=BLUE, label="slope dc/ds")
    for place, name in ((0.0, "surface"), (eps, "eps")):
        left.axvline(place, color="0.8", lw=1)
        left.text(place + 0.02, 0.72, name, color=GREY)
    left.set(
        xlabel="distance s of a sphere's skin [m]",
        title=f"Cost with a reach eps of {eps} m",
        ylim=(-1.1, 0.85),
    )
    left.legend(loc="lower right")
    c = isdf.CostField(field, eps).cost(points, 0.2)
    image = show(right, points, c.numpy(), cmap="Reds", vmin=0, vmax=0.7)
    for solid in solids:
        right.contour(
            points[0, :, 0],
            points[:, 0, 1],
            solid.distance(points),
            levels=[0.0],
            colors="black",
            linewidths=1.3,
        )
    right.plot(*line.waypoints.T, "--", color=GREY, label="first guess: the straight line")
    right.plot(*result.trajectory.waypoints.T, color=GREEN, lw=2, label="CHOMP's path")
    for q in result.trajectory.waypoints[::7].tolist():
        right.add_patch(Circle((q[0], q[1]), 0.2, fill=False, ec=GREEN, lw=0.8))
    right.set(xlabel="[m]", title="Cost for a disc of radius 0.2 m, and its way")
    right.legend(loc="upper left", fontsize=8)
    figure.colorbar(image, ax=right, label="cost [m]", shrink=0.85)
    save(figure, out, "cost")


def looked_at(world: World, eye: tuple[float, float, float], headings: np.ndarray) -> list[isdf.DepthFrame]:
    """Frames of a camera that turns about itself, level but for a slight look down."""
    camera = DepthCamera(world, PinholeCamera.from_fov(160, 120, 1.2))
    frames = []
    for i, heading in enumerate(headings):
        camera.T_link_camera = looking(eye, (np.cos(heading), np.sin(heading), -0.35))
        frame = camera.render()
        frames.append(isdf.DepthFrame(frame.depth, frame.T_world_camera, frame.camera, 0.1 * i))
    return frames


def draw_map(out: Path) -> None:
    """What a few views prove, what the default map answers, and how sure it is."""
    points = slice_points((-4.2, -3.2), (4.2, 3.2), 0.04)
    mapper, eye = isdf.Mapper(), (-0.4, -0.6, 1.2)
    with World(make_scene("office", 3)) as world:
        for frame in looked_at(world, eye, np.linspace(-0.3, 2.6, 14)):
            mapper.integrate(frame)
        mapper.refresh()
        truth = world.field().distance(points).numpy()
    field, lattice, bricks = mapper.field(), mapper.lattice, mapper.bricks
    shape = np.array(lattice.shape)
    upper_corner = lattice.spacing * (lattice.corner + shape)
    seeds = surface_seeds(bricks.arrays, *bricks.box(lattice.spacing * lattice.corner, upper_corner))[:, :3]
    evidence = lattice.read("evidence", np.zeros_like(shape), shape)
    proven = gather(seeds, evidence, lattice.corner, lattice.spacing)
    nodes = np.rint(points.numpy() / lattice.spacing).astype(int) - lattice.corner
    nodes = tuple(np.moveaxis(np.clip(nodes, 0, shape - 1), -1, 0))
    panels = {
        "upper bound: closest surface seen": proven.upper[nodes],
        "lower bound: closest place not looked at": proven.lower[nodes],
        "the map's distance, between the two": field.distance(points).numpy(),
        "true distance": truth,
    }
    figure = Figure(figsize=(11, 10.6), layout="constrained")
    axes = figure.subplots(3, 2).ravel()
    x, y = points[0, :, 0], points[:, 0, 1]
    for ax, (title, values) in zip(axes, panels.items(), strict=False):
        image = show(ax, points, values)
        ax.contour(x, y, truth, levels=[0.0], colors="black", linewidths=0.7)
        ax.set_title(title, fontsize=10)
    figure.colorbar(image, ax=list(axes[:4]), label="[m]", shrink=0.6)
    sure = show(axes[4], points, field.confidence(points).numpy(), cmap="viridis", vmin=0, vmax=1)
    axes[4].set_title("confidence that it is right to 5 cm", fontsize=10)
    state = np.where(proven.free[nodes], 0, np.where(proven.unknown[nodes], 2, 1))
    show(axes[5], points, state, cmap=ListedColormap(["#d5f5e3", "#1b2631", "#aab7b8"]), vmin=-0.5, vmax=2.5)
    axes[5].set_title("seen free (green), at a seen surface (dark), not seen (grey)", fontsize=10)
    figure.colorbar(sure, ax=list(axes[4:]), label="confidence", shrink=0.7)
    for ax in axes:
        ax.plot(eye[0], eye[1], "^", color="black", ms=7)
    save(figure, out, "map")


def _boxes(axes: Axes, boxes: dict[str, tuple[float, float, str]], width: float, height: float) -> None:
    for text, (x, y, colour) in boxes.items():
        axes.add_patch(
            FancyBboxPatch(
                (x - width / 2, y - height / 2), width, height, "round,pad=0.02", fc=colour, ec="0.4", lw=1
            )
        )
        axes.text(x, y, text, ha="center", va="center", fontsize=9.5, linespacing=1.4)


def _arrow(
    axes: Axes, begin: tuple[float, float], end: tuple[float, float], text: str, up: float = 0.12
) -> None:
    style = {"arrowstyle": "-|>", "lw": 1.4, "color": "0.3", "mutation_scale": 13}
    axes.annotate("", end, begin, arrowprops=style)
    x, y = (begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2
    axes.text(x, y + up, text, ha="center", va="center", fontsize=8.5, color="0.25")


def draw_loop(out: Path) -> None:
    """The closed loop as boxes and arrows."""
    figure = Figure(figsize=(9.6, 3.5), layout="constrained")
    axes = figure.subplots()
    boxes = {
        "depth camera\nin the robot's head": (0.0, 1.3, "#fdebd0"),
        "mapper\nintegrate(frame)": (2.6, 1.3, "#d6eaf8"),
        "snapshot\ndistance and gradient": (5.2, 1.3, "#d6eaf8"),
        "robot": (0.0, 0.0, "#fdebd0"),
        "controller\nmodel predictive": (2.6, 0.0, "#d5f5e3"),
        "planner\nsearch, CHOMP, check": (5.2, 0.0, "#d5f5e3"),
    }
    _boxes(axes, boxes, 1.75, 0.7)
    _arrow(axes, (0.9, 1.3), (1.7, 1.3), "depth, pose")
    _arrow(axes, (3.5, 1.3), (4.3, 1.3), "copy")
    _arrow(axes, (5.2, 0.93), (5.2, 0.37), "")
    axes.text(5.3, 0.65, "asked at every sphere", fontsize=8.5, color="0.25", va="center")
    _arrow(axes, (4.3, 0.0), (3.5, 0.0), "trajectory")
    _arrow(axes, (1.7, 0.0), (0.9, 0.0), "velocities")
    _arrow(axes, (0.0, 0.37), (0.0, 0.93), "")
    axes.text(0.1, 0.65, "moves the camera", fontsize=8.5, color="0.25", va="center")
    caption = "Every round asks the newest snapshot whether the rest of the plan is still free; if not, it plans again."
    axes.text(2.6, -0.72, caption, ha="center", fontsize=9, color="0.25")
    axes.set(xlim=(-1.1, 6.9), ylim=(-0.95, 1.8))
    axes.axis("off")
    save(figure, out, "loop")


def draw_packages(out: Path) -> None:
    """The three packages, and what passes between them."""
    figure = Figure(figsize=(9.6, 3.9), layout="constrained")
    axes = figure.subplots()
    boxes = {
        "isdf\ncamera, frames, mappers,\nfields, files, exports": (0.0, 0.0, "#d6eaf8"),
        "planning\nprotocols, CHOMP, search,\nvalidation, timing, tracking": (3.4, 0.0, "#d5f5e3"),
        "robots\nURDF, spheres, kinematics,\nsimulation": (6.8, 0.0, "#fdebd0"),
        "examples, tests, benchmarks\nwhere all three meet": (3.4, 1.75, "0.93"),
    }
    _boxes(axes, boxes, 2.45, 0.95)
    _arrow(axes, (1.28, 0.0), (2.12, 0.0), "", 0.15)
    axes.text(
        1.7,
        -0.98,
        "a DistanceField:\ndistance, gradient,\nconfidence",
        ha="center",
        va="center",
        fontsize=8.5,
        color="0.25",
    )
    _arrow(axes, (5.52, 0.0), (4.68, 0.0), "", 0.15)
    axes.text(
        5.1, -0.98, "a SphereRobot:\nlimits, spheres(q)", ha="center", va="center", fontsize=8.5, color="0.25"
    )
    for x in (0.0, 3.4, 6.8):
        axes.annotate(
            "",
            (x, 0.52),
            (3.4 + 0.3 * (x - 3.4), 1.22),
            arrowprops={"arrowstyle": "-|>", "ls": "--", "color": "0.5"},
        )
    axes.text(0.35, 1.2, "import", fontsize=8.5, color="0.4")
    axes.set(xlim=(-1.4, 8.2), ylim=(-1.25, 2.35))
    axes.axis("off")
    save(figure, out, "packages")


def main(options: Pictures) -> None:
    """Draw them all."""
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    for draw in (draw_field, draw_bounds, draw_cost, draw_map, draw_loop, draw_packages):
        draw(options.out)


if __name__ == "__main__":
    main(tyro.cli(Pictures))
