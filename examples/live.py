"""Watching an episode: robot, map and plan as they are now, for a viewer in the browser and for a recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import robots
from examples.arm import parked
from isdf.errors import NotReadyError
from isdf.meshing import zero_level_mesh
from isdf.viewer import Line, Recorder, Shape, Spheres, Viewer, ViewState
from planning.protocols import DistanceField
from planning.replanning import ReplanningLoop
from robots.simulation import DepthFrame, SimulatedMobileRobot, World
from robots.simulation.poses import link_frames
from robots.simulation.ray_casting import link_surfaces

SHOWN_EVERY, RECORDED_EVERY, FIELD_EVERY = 0.1, 0.1, 0.5
"""Least times between two states: for the viewer [s of wall time], recorded [s of the robot's time], of the map [s]."""
ABOVE_FLOOR = 0.08
"""Where ways of the base are drawn [m]."""
CLOSE = 0.16
"""Of the finer map round an object that much is drawn to all sides [m]."""
CLOSE_COLOUR = (120, 190, 215)
PLAN_COLOUR, WAY_COLOUR, TOOL_COLOUR = (40, 170, 60), (215, 50, 40), (150, 60, 190)


@dataclass(frozen=True)
class LiveOptions:
    """How an episode is watched."""

    viewer: bool = False
    """Show the episode live in the browser; the page is printed."""
    viewer_port: int = 8080
    """Of that page."""
    record: Path | None = None
    """Folder for a recording, which `isdf view FOLDER` plays without simulating anything."""


class Live:
    """Shows an episode as it goes on, if that is asked for; to the robot it is a disturbance that changes nothing.

    Args:
        options: see `LiveOptions`.
        model: the robot's, for its spheres.
        world: with the robot.
        mapper: whose map is shown.
    """

    def __init__(self, options: LiveOptions, model: robots.Robot, world: World, mapper: Any) -> None:
        self.viewer = Viewer(options.viewer_port) if options.viewer else None
        self.recorder = Recorder(options.record) if options.record else None
        self._model, self._world, self._mapper = model, world, mapper
        self._robot: SimulatedMobileRobot | None = None
        self.last_frame: DepthFrame | None = None
        """What the robot has seen last."""
        self._field: tuple[Any, Any, float] = (None, None, -np.inf)  # field, of which map, made at
        self._goal: np.ndarray | None = None
        self._lines: dict[str, Line] = {}
        self._shapes: dict[str, Shape] = {}
        self._links: list[tuple[int, str]] = []
        self._way: list[np.ndarray] = []
        self._status = ""
        self._shown_at = self._recorded_at = -np.inf
        if self.viewer is not None:
            print(f"viewer: {self.viewer.url}")

    @property
    def active(self) -> bool:
        """Whether anything is shown or recorded."""
        return self.viewer is not None or self.recorder is not None

    def timer(self) -> float:
        """CPU time of this process without the viewer's [s]."""
        return time.process_time() - (self.viewer.cpu_seconds() if self.viewer else 0.0)

    def frame(self, frame: DepthFrame | None) -> DepthFrame | None:
        """The image as it is."""
        self.last_frame = self.last_frame if frame is None else frame
        return frame

    def advance(self, robot: SimulatedMobileRobot, duration: float) -> None:
        """Show what is, and wait while somebody has paused."""
        if not self.active:
            return
        self._robot = robot
        self._show(robot)
        if self.viewer is not None and self.viewer.hold():
            self._shown_at = -np.inf

    def follow(self, loop: ReplanningLoop, goal_moves: bool = False) -> None:
        """Show the plan of a drive, and drive to where somebody has dragged its goal; for the loop's `watch`."""
        if not self.active:
            return
        if goal_moves:
            self._goal = loop.goal
            moved = self.moved_goal(loop.goal)
            if moved is not loop.goal:
                loop.change_goal(moved)
        way = np.zeros((0, 2)) if loop.plan is None else loop.plan.trajectory.waypoints.numpy()
        self.line("plan", np.column_stack([way, np.full(len(way), ABOVE_FLOOR)]))
        self._status = _said(loop)

    def drive_on(self, loop: ReplanningLoop) -> None:
        """After a drive: drive to wherever somebody drags the goal, until nobody watches any more."""
        if self.viewer is None or not self.viewer.watched:
            return
        print("the drive is over: drag the goal to drive on, close the page or press Ctrl-C to end")
        loop.watch = lambda loop: self.follow(loop, goal_moves=True)
        try:
            while self.viewer.watched:
                goal = self.viewer.controls.take_goal()
                if goal is None:
                    time.sleep(0.1)
                else:
                    self.say(loop.drive_to(goal).message)
        except KeyboardInterrupt:
            pass

    def moved_goal(self, goal: np.ndarray) -> np.ndarray:
        """Where somebody has dragged the goal; the same array if nobody has."""
        moved = self.viewer.controls.take_goal() if self.viewer else None
        self._goal = goal if moved is None else moved
        return self._goal

    def say(self, status: str) -> None:
        """What the robot is about, in a line; shown at once."""
        self._status, self._shown_at = status, -np.inf
        if self.active and self._robot is not None:
            self._show(self._robot)

    def line(
        self, name: str, points: np.ndarray, colour: tuple[int, int, int] = PLAN_COLOUR, width: float = 0.03
    ) -> None:
        """Draw a line through points (n, 3) [m] in place of the last one of that name."""
        if self.active:
            self._lines = self._lines | {name: Line(np.array(points, np.float32), colour, width)}

    def look_closely(self, close: DistanceField, point: np.ndarray) -> None:
        """Draw the zero level of a finer map round a point [m]."""
        if self.active:
            around = torch.as_tensor(np.stack([point - CLOSE, point + CLOSE]), dtype=torch.float32)
            mesh = zero_level_mesh(close, 0.006, around, padding=0.0)
            self._shapes = self._shapes | {"close map": _shape(mesh, CLOSE_COLOUR)}

    def reach(self, ways: Sequence[torch.Tensor]) -> None:
        """Draw the way of the hand along planned postures (n, dof) of the arm, the base where it is."""
        if self.active:
            model, _ = parked(self._model, self._world.robot_state()[0])
            assert model.tool_link is not None
            poses = model.link_poses(torch.cat(list(ways)), [model.tool_link])[:, 0]
            self.line("reach", poses[:, :3, 3].numpy(), TOOL_COLOUR, 0.01)

    def close(self) -> None:
        """End; with a browser connected not before it has left, or Ctrl-C."""
        try:
            if self.viewer is not None and self.viewer.watched:
                print("over: close the page or press Ctrl-C to end")
                self.viewer.linger()
        except KeyboardInterrupt:
            pass
        if self.viewer is not None:
            self.viewer.close()
        if self.recorder is not None:
            self.recorder.close()

    def _show(self, robot: SimulatedMobileRobot) -> None:
        now = time.monotonic()
        here = np.array([*robot.base_state()[:2], ABOVE_FLOOR])
        if not self._way or np.linalg.norm(here - self._way[-1]) > 0.02:
            self._way.append(here)
        show = self.viewer is not None and now >= self._shown_at + SHOWN_EVERY
        record = self.recorder is not None and robot.time >= self._recorded_at + RECORDED_EVERY - 1e-6
        if not show and not record:
            return
        compose = self._composer(robot)
        if show and self.viewer is not None:
            self.viewer.show(compose)
            self._shown_at = now
        if record and self.recorder is not None:
            self.recorder.add(compose)
            self._recorded_at = robot.time

    def _composer(self, robot: SimulatedMobileRobot) -> Callable[[], ViewState]:
        """Takes what changes now; the rest is done in the thread that draws."""
        shapes, poses = self._bodies(robot)
        posture = torch.as_tensor(robot.posture(), dtype=torch.float32)
        way, model = list(self._way), self._model
        given = (robot.time, self._status, self.last_frame, self._snapshot(), shapes, poses)
        lines, goal = self._lines, self._goal

        def compose() -> ViewState:
            centres, radii = model.spheres(posture)
            balls = Spheres(centres.numpy(), radii.numpy())
            driven = Line(np.array(way, np.float32), WAY_COLOUR)
            return ViewState(*given, {"spheres": balls}, {**lines, "driven": driven}, goal)

        return compose

    def _snapshot(self) -> Any:
        """The map, at most `FIELD_EVERY` old; None before it shows anything."""
        field, state, made = self._field
        now, mapper = time.monotonic(), self._mapper
        newest = (mapper.frames_seen, mapper.steps)
        if newest != state and now >= made + FIELD_EVERY:
            try:
                self._field = (mapper.field(), newest, now)
            except NotReadyError:
                return field
        return self._field[0]

    def _bodies(self, robot: SimulatedMobileRobot) -> tuple[Mapping[str, Shape], dict[str, np.ndarray]]:
        """The robot's links and what can be moved, as they are: meshes, and where they are."""
        client, body = self._world.client, robot.simulated.body
        if not self._links:
            for surface in link_surfaces(client, body):
                self._links.append((surface.link, f"robot/{surface.link}"))
                self._shapes = self._shapes | {f"robot/{surface.link}": _shape(surface.mesh)}
        frames = link_frames(client, body, [link for link, _ in self._links])
        poses = dict(zip([name for _, name in self._links], frames, strict=True))
        for name, solid in self._world.solids.items():
            if solid.mass > 0:
                if f"things/{name}" not in self._shapes:
                    self._shapes = self._shapes | {
                        f"things/{name}": _shape(solid.local_mesh(), (230, 120, 90))
                    }
                poses[f"things/{name}"] = self._world.object_pose(name)
        return self._shapes, poses


def _shape(mesh: Any, colour: tuple[int, int, int] = (225, 228, 232)) -> Shape:
    return Shape(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32), colour)


def _said(loop: ReplanningLoop) -> str:
    if loop.report.rounds == 0:
        return "looking around"
    if loop.plan is None:
        return f"standing, without a plan{': ' + loop.report.message if loop.report.message else ''}"
    way = loop.plan.trajectory.waypoints
    length = float((way[1:] - way[:-1]).norm(dim=1).sum())
    ends = "to the goal" if loop.leads_to_goal else "as near to the goal as the map shows a way"
    return f"plan {loop.report.plans}: {length:.1f} m {ends}, made in {loop.last_planning:.2f} s"
