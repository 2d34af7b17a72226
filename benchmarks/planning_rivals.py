"""Planners to compare with, each on one problem at a time: this project's, OMPL's, VAMP's and Tesseract's.

The others are optional: a planner whose package is missing is left out, with a word on it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.planning_check import CheckedRobot
from planning.exact_shape import exact_shape
from planning.problems import Problem
from planning.solve import Solver
from robots import Robot

OMPL_RESOLUTION = 0.001  # of the space's extent, between two states that OMPL tests on an edge

# Of a base that stands on the floor only what its wheels touch would collide.
IGNORED = {"fetch": frozenset({"base_link"})}


@dataclass(frozen=True)
class Answer:
    """What a planner made of a problem: waypoints in the problem's order of joints, if it found a path."""

    waypoints: list[list[float]]
    times: list[float]
    status: str


Planner = Callable[[Problem, float], Answer]


def checked_robot(name: str, robot: Robot) -> CheckedRobot:
    """A ready-made robot for the checker."""
    allowed = robot.sphere_set.ignored_pairs | robot.tree.neighbours(tuple(robot.sphere_set.spheres))
    tool = robot.tool_link
    assert tool is not None
    return CheckedRobot(robot.urdf_path, tool, frozenset(allowed), IGNORED.get(name, frozenset()))


def ours(robot_name: str, robot: Robot) -> Planner:
    """Search, CHOMP and check, as `python -m planning solve` runs them."""
    solver = Solver(robot)

    def plan(problem: Problem, deadline: float) -> Answer:
        result = solver.solve(problem, deadline)
        return Answer(result["waypoints"], result["times"], result["status"])

    return plan


def ompl(robot_name: str, robot: Robot) -> Planner:
    """OMPL's RRT-Connect with its path simplifier; it asks our compiled collision test, through Python."""
    from ompl import base, geometric, util

    from planning.compiled.states import free

    util.setLogLevel(util.LogLevel.LOG_NONE)
    solver = Solver(robot)

    def plan(problem: Problem, deadline: float) -> Answer:
        ends_at = time.perf_counter() + deadline
        posed, validation = solver.robot_for(problem), solver.config.planner.chomp.validation
        shape = exact_shape(posed, problem.field)
        assert shape is not None
        world = shape.world._replace(margin=validation.margin, self_margin=validation.self_margin)
        order = [problem.joints.index(name) for name in posed.joint_names]
        back = np.argsort(order)
        space = base.RealVectorStateSpace(len(order))
        bounds = base.RealVectorBounds(len(order))
        for j in range(len(order)):
            bounds.setLow(j, max(-np.pi, float(world.low[j])))
            bounds.setHigh(j, min(np.pi, float(world.high[j])))
        space.setBounds(bounds)
        setup = geometric.SimpleSetup(space)
        setup.setStateValidityChecker(
            lambda s: bool(free(world, np.array([s[j] for j in range(len(order))])))
        )
        setup.getSpaceInformation().setStateValidityCheckingResolution(OMPL_RESOLUTION)
        setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
        start, goal = space.allocState(), space.allocState()
        for state, q in ((start, problem.start[order]), (goal, problem.goal[order])):
            for j, value in enumerate(q.tolist()):
                state[j] = value
        setup.setStartAndGoalStates(start, goal)
        setup.solve(ends_at - time.perf_counter())
        if not setup.haveExactSolutionPath():
            return Answer([], [], "no path")
        setup.simplifySolution(max(0.01, ends_at - time.perf_counter()))
        path = [[s[j] for j in range(len(order))] for s in setup.getSolutionPath().getStates()]
        return Answer(np.array(path)[:, back].tolist(), [], "success")

    return plan


def vamp(robot_name: str, robot: Robot) -> Planner:
    """VAMP's vectorised RRT-Connect and simplifier, on its own spheres and compiled robot."""
    import vamp
    from scipy.spatial.transform import Rotation

    module, search, settings, simplify = vamp.configure_robot_and_planner_with_kwargs(robot_name, "rrtc")

    def environment(problem: Problem) -> Any:
        scene = vamp.Environment()
        for solid in problem.solids:
            turn = Rotation.from_quat(solid.quat_xyzw).as_euler("xyz").tolist()
            if solid.kind == "box":
                scene.add_cuboid(vamp.Cuboid(list(solid.position), turn, [d / 2 for d in solid.dimensions]))
            else:
                height, radius = solid.dimensions
                scene.add_capsule(vamp.Cylinder(list(solid.position), turn, radius, height))
        return scene

    def plan(problem: Problem, deadline: float) -> Answer:
        scene, sampler = environment(problem), module.halton()
        found = search(problem.start.tolist(), problem.goal.tolist(), scene, settings, sampler)
        if not found.solved:
            return Answer([], [], "no path")
        short = module.simplify(found.path, scene, simplify, sampler)
        return Answer(np.asarray(short.path.numpy()).tolist(), [], "success")

    return plan


def tesseract(robot_name: str, robot: Robot) -> Planner:
    """Tesseract's TrajOpt, on the collision meshes, from one seed after the other."""
    from benchmarks.tesseract_rival import trajopt_solver

    checked = checked_robot(robot_name, robot)
    solvers: dict[tuple[str, ...], Any] = {}

    def plan(problem: Problem, deadline: float) -> Answer:
        if problem.joints not in solvers:
            order = [robot.joint_names.index(name) for name in problem.joints]
            limits = robot.joint_limits[order].numpy()
            solvers[problem.joints] = trajopt_solver(checked, problem.joints, limits)
        found = solvers[problem.joints](problem, deadline)
        return Answer(found, [], "success" if found else "no path")

    return plan


PLANNERS: Mapping[str, Callable[[str, Robot], Planner]] = {
    "ours": ours,
    "ompl": ompl,
    "vamp": vamp,
    "tesseract": tesseract,
}
