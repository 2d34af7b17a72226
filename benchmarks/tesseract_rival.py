"""Tesseract's TrajOpt (Schulman et al., IJRR 2014) on the planning problems: sequential convex optimisation from lines.

The Python package carries no robot and no plugins' addresses: the semantic description is written here from the same
pairs of links that may touch as everybody's, and the collision plugin is looked up among the package's libraries.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import tesseract_robotics
from scipy.spatial.transform import Rotation
from tesseract_robotics import tesseract_command_language as language
from tesseract_robotics import tesseract_common as common
from tesseract_robotics import tesseract_environment as environment
from tesseract_robotics import tesseract_geometry as geometry
from tesseract_robotics import tesseract_motion_planners as planners
from tesseract_robotics import tesseract_motion_planners_trajopt as trajopt
from tesseract_robotics import tesseract_scene_graph as graph
from tesseract_robotics import tesseract_srdf as srdf

from benchmarks.planning_check import TOLERANCE, CheckedRobot
from planning.primitive_field import Solid
from planning.problems import Problem

STATES = 30
"""Of a trajectory, its ends included."""
ROOM = 0.01
"""To obstacles [m], asked for by a cost."""
SEGMENT = 0.05
"""Between two tested states [rad, as a norm]."""
SPREAD = 0.5
"""Standard deviation [rad | m] of the points by whose way later seeds go."""
PLANNER, GROUP = "TrajOptMotionPlannerTask", "arm"

Solve = Callable[[Problem, float], list[list[float]]]


def urdf_text(robot: CheckedRobot) -> str:
    """The URDF with meshes as URLs, without what is only looked at and the shapes of links that have no say."""
    root = ElementTree.parse(robot.urdf).getroot()
    for link in root.iter("link"):
        unwanted = ("visual", "collision") if link.get("name") in robot.ignored_links else ("visual",)
        for shape in [shape for kind in unwanted for shape in link.findall(kind)]:
            link.remove(shape)
    for mesh in root.iter("mesh"):
        mesh.set("filename", Path(mesh.get("filename", "")).as_uri())
    return ElementTree.tostring(root, encoding="unicode")


def srdf_text(robot: CheckedRobot, joints: Iterable[str]) -> str:
    """The semantic description: one group of joints, and links that may touch."""
    name = ElementTree.parse(robot.urdf).getroot().get("name")
    group = "".join(f'<joint name="{joint}"/>' for joint in joints)
    pairs = sorted(sorted(pair) for pair in robot.allowed if len(pair) == 2)
    touch = "".join(f'<disable_collisions link1="{a}" link2="{b}" reason="Allowed"/>' for a, b in pairs)
    return f'<robot name="{name}" version="1.0.0"><group name="{GROUP}">{group}</group>{touch}</robot>'


def bullet_plugins() -> str:
    """Where Bullet's contact managers are, as the package's loader wants it."""
    folder = Path(tesseract_robotics.__file__).parents[1] / "tesseract_robotics.libs"
    library = next(folder.glob("libtesseract_collision_bullet_factories-*.so")).stem.removeprefix("lib")
    return f"""contact_manager_plugins:
  search_paths: [{folder}]
  search_libraries: [{library}]
  discrete_plugins: {{default: B, plugins: {{B: {{class: BulletDiscreteBVHManagerFactory}}}}}}
  continuous_plugins: {{default: B, plugins: {{B: {{class: BulletCastBVHManagerFactory}}}}}}
"""


class World:
    """A robot in Tesseract's environment, and the obstacles of the problem at hand."""

    def __init__(self, robot: CheckedRobot, joints: Iterable[str]) -> None:
        self.environment = environment.Environment()
        urdf, semantics = urdf_text(robot), srdf_text(robot, joints)
        if not self.environment.init(urdf, semantics, common.GeneralResourceLocator()):
            raise RuntimeError(f"Tesseract does not read {robot.urdf}.")
        plugins = srdf.parseContactManagersPluginConfigString(bullet_plugins())
        self._apply(environment.AddContactManagersPluginInfoCommand(plugins))
        self._obstacles: list[str] = []

    def show(self, solids: Iterable[Solid]) -> None:
        """Put these obstacles in the place of the last ones."""
        for name in self._obstacles:
            self._apply(environment.RemoveLinkCommand(name))
        self._obstacles = []
        root = self.environment.getRootLinkName()
        for i, solid in enumerate(solids):
            name, collision, joint = f"obstacle_{i}", graph.Collision(), graph.Joint(f"to_obstacle_{i}")
            if solid.kind == "box":
                collision.geometry = geometry.Box(*solid.dimensions)
            else:
                height, radius = solid.dimensions
                collision.geometry = geometry.Cylinder(radius, height)
            link = graph.Link(name)
            link.collision.append(collision)
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_quat(solid.quat_xyzw).as_matrix()
            pose[:3, 3] = solid.position
            joint.parent_link_name, joint.child_link_name = root, name
            joint.type = graph.JointType_FIXED
            joint.parent_to_joint_origin_transform = common.Isometry3d(pose)
            self._apply(environment.AddLinkCommand(link, joint, False))
            self._obstacles.append(name)

    def pose(self, posture: Mapping[str, float]) -> None:
        """Set joints that are not planned, too; joints that it does not move would crash it."""
        known = [name for name in self.environment.getActiveJointNames() if name in posture]
        if known:
            self.environment.setState(known, np.array([posture[name] for name in known]))

    def _apply(self, command: Any) -> None:
        if not self.environment.applyCommand(command):
            raise RuntimeError(f"Tesseract refuses {type(command).__name__}.")


def profiles() -> Any:
    """TrajOpt's settings: a constraint of no contact deeper than the checker allows, a cost of less than `ROOM`."""
    composite, plan = trajopt.TrajOptDefaultCompositeProfile(), trajopt.TrajOptDefaultPlanProfile()
    for config, margin in (
        (composite.collision_constraint_config, -TOLERANCE),
        (composite.collision_cost_config, ROOM),
    ):
        config.enabled, config.safety_margin, config.safety_margin_buffer = True, margin, ROOM
        config.type = trajopt.CollisionEvaluatorType_DISCRETE_CONTINUOUS
    composite.smooth_velocities, composite.smooth_accelerations, composite.smooth_jerks = True, False, False
    composite.longest_valid_segment_length = SEGMENT
    plan.cartesian_cost_config.enabled = plan.cartesian_constraint_config.enabled = False
    found = language.ProfileDictionary()
    for profile in (composite, plan):
        found.addProfile(PLANNER, "DEFAULT", profile)
    return found


def program(joints: Sequence[str], seed: np.ndarray) -> Any:
    """A seed (N, dof) [rad | m] as a program: both ends fixed, the states between them free."""
    composite = language.CompositeInstruction("DEFAULT")
    composite.setManipulatorInfo(common.ManipulatorInfo(GROUP, "", ""))
    for i, q in enumerate(seed):
        if i in (0, len(seed) - 1):
            waypoint = language.JointWaypointPoly_wrap_JointWaypoint(language.JointWaypoint(list(joints), q))
        else:
            waypoint = language.StateWaypointPoly_wrap_StateWaypoint(language.StateWaypoint(list(joints), q))
        move = language.MoveInstruction(waypoint, language.MoveInstructionType_FREESPACE, "DEFAULT")
        composite.appendMoveInstruction(language.MoveInstructionPoly_wrap_MoveInstruction(move))
    return composite


def waypoints(results: Any) -> list[list[float]]:
    """Joint vectors of a solved program; every step has a name since what it came from must outlive it."""
    found, instructions = [], results.flatten()
    for instruction in instructions:
        move = language.InstructionPoly_as_MoveInstructionPoly(instruction)
        waypoint = move.getWaypoint()
        if waypoint.isStateWaypoint():
            state = language.WaypointPoly_as_StateWaypointPoly(waypoint)
        else:
            state = language.WaypointPoly_as_JointWaypointPoly(waypoint)
        found.append(np.ravel(state.getPosition()).tolist())
    return found


def seeds(start: np.ndarray, goal: np.ndarray, limits: np.ndarray) -> Iterator[np.ndarray]:
    """The straight line (N, dof), then lines by way of points drawn around its middle; limits (dof, 2)."""
    yield np.linspace(start, goal, STATES)
    rng, half = np.random.default_rng(0), STATES // 2
    while True:
        via = np.clip((start + goal) / 2 + rng.normal(0, SPREAD, len(start)), *limits.T)
        there = np.linspace(start, via, half, endpoint=False)
        yield np.concatenate([there, np.linspace(via, goal, STATES - half)])


def trajopt_solver(robot: CheckedRobot, joints: Sequence[str], limits: np.ndarray) -> Solve:
    """TrajOpt from one seed after the other until one is solved; limits (dof, 2) [rad | m]."""
    world, settings = World(robot, joints), profiles()
    turns = np.clip(limits, -np.pi, np.pi)

    def solve(problem: Problem, deadline: float) -> list[list[float]]:
        ends_at = time.perf_counter() + deadline
        world.show(problem.solids)
        world.pose(problem.posture)
        for seed in seeds(problem.start.numpy(), problem.goal.numpy(), turns):
            request = planners.PlannerRequest()
            request.env, request.profiles = world.environment, settings
            request.instructions = program(joints, seed)
            response = trajopt.TrajOptMotionPlanner(PLANNER).solve(request)
            if response.successful:
                return waypoints(response.results)
            if time.perf_counter() > ends_at:
                break
        return []

    return solve
