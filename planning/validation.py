"""A dense check of a trajectory, independent of whatever made it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from planning.errors import ConfigError, TrajectoryError
from planning.exact_shape import exact_shape
from planning.numbers import refuse_nan
from planning.protocols import CostField, DistanceField, LinkedRobot, SelfCollidingRobot, SphereRobot
from planning.result import Status
from planning.sphere_kinematics import kinematics_of
from planning.trajectory import Trajectory
from planning.workspace import Workspace, WorkspaceConfig

MAX_REFINEMENTS = 10  # each makes the motion between states proportionally smaller; two or three are enough


@dataclass(frozen=True)
class ValidationConfig:
    """What a valid trajectory is.

    Args:
        max_step: no sphere centre moves further than this [m] between two states tested, so a state in
            between is at most half of it less clear.
        max_joint_step: no joint moves further than this [rad | m] between two states tested.
        margin: clearance [m] from obstacles that every sphere must keep.
        self_margin: gap [m] that self-collision pairs must keep.
        limit_tolerance: excess over a joint limit [rad | m] taken for rounding.
        workspace: rules for the floor and for unknown space, which fails the check only if it is forbidden.
    """

    max_step: float = 0.01
    max_joint_step: float = 0.1
    margin: float = 0.0
    self_margin: float = 0.0
    limit_tolerance: float = 1e-5
    workspace: WorkspaceConfig = field(default_factory=WorkspaceConfig)

    def __post_init__(self) -> None:
        refuse_nan(self)
        if self.max_step <= 0 or self.max_joint_step <= 0:
            raise ConfigError(
                f"ValidationConfig: max_step and max_joint_step must be positive, got "
                f"{self.max_step:g} m and {self.max_joint_step:g}."
            )


@dataclass(frozen=True)
class Validation:
    """Verdict of the dense check.

    Args:
        status: SUCCESS or the first failing of: field, limits, start, goal, obstacles, self-collision, unknown space.
        message: the reason in words.
        clearance: least f - r [m] over all states and spheres; NaN if the field is not finite somewhere.
        self_clearance: least gap [m] of the self-collision pairs; inf without any.
        waypoint: index of the waypoint at or before the worst state, for the failing test or else the
            clearance.
        time: of the worst state [s].
        link: of the sphere that is worst there, "" if none is.
        states: how many states were tested.
    """

    status: Status
    message: str
    clearance: float
    self_clearance: float
    waypoint: int
    time: float
    link: str
    states: int

    @property
    def success(self) -> bool:
        """True if the trajectory is valid."""
        return self.status is Status.SUCCESS


def check(
    robot: SphereRobot,
    trajectory: Trajectory,
    sdf: DistanceField | CostField,
    config: ValidationConfig | None = None,
) -> Validation:
    """Test the start, the goal and every state in between, so densely that no sphere skips an obstacle.

    Raises:
        TrajectoryError: if the trajectory is for another number of joints than the robot's.
    """
    config = config or ValidationConfig()
    check_dofs(robot, trajectory)
    workspace = Workspace(robot, sdf, eps=1.0, config=config.workspace)
    samples = _dense_states(robot, trajectory, config)
    worst_depth, worst_sphere, worst_gap, worst_pair = _measure(robot, workspace, samples.states, config)
    report = _Report(robot, trajectory, samples, worst_depth, worst_gap)
    name = _sphere_name(robot)

    if worst_depth.isnan().any():
        i = int(worst_depth.isnan().nonzero()[0])
        return report.verdict(
            Status.INVALID_FIELD, i, name(int(worst_sphere[i])), "the field is NaN at {link}"
        )
    excess = _limit_excess(robot, samples.states)
    if excess.max() > config.limit_tolerance:
        i, joint = divmod(int(excess.argmax()), robot.num_dofs)
        low, high = robot.joint_limits[joint].tolist()
        text = (
            f"joint {robot.joint_names[joint]} is at {float(samples.states[i, joint]):.4g}, "
            f"outside its limits [{low:.4g}, {high:.4g}]"
        )
        return report.verdict(Status.JOINT_LIMITS, i, "", text)

    def obstacle_text(i: int) -> str:
        depth = float(worst_depth[i])
        where = f"{-depth:.3f} m inside an obstacle" if depth < 0 else f"{depth:.3f} m from an obstacle"
        needed = f" (margin {config.margin:g} m)" if config.margin else ""
        return f"{name(int(worst_sphere[i]))} is {where}{needed}"

    def self_text(i: int) -> str:
        first, second = worst_pair[i].tolist()
        return f"{name(first)} and {name(second)} have a gap of {float(worst_gap[i]):.3f} m"

    last = len(samples.states) - 1
    for i, status in ((0, Status.START_IN_COLLISION), (last, Status.GOAL_IN_COLLISION)):
        if worst_depth[i] < config.margin:
            return report.verdict(status, i, name(int(worst_sphere[i])), obstacle_text(i))
        if worst_gap[i] < config.self_margin:
            return report.verdict(status, i, name(int(worst_pair[i, 0])), self_text(i))
    i = int(worst_depth.argmin())
    if worst_depth[i] < config.margin:
        return report.verdict(Status.COLLISION, i, name(int(worst_sphere[i])), obstacle_text(i))
    j = int(worst_gap.argmin())
    if worst_gap[j] < config.self_margin:
        return report.verdict(Status.SELF_COLLISION, j, name(int(worst_pair[j, 0])), self_text(j))
    if config.workspace.unknown_forbidden:
        state, sphere = _first_unknown(robot, workspace, samples.states)
        if state >= 0:
            return report.verdict(Status.UNKNOWN_SPACE, state, name(sphere), "{link} is in unknown space")
    return report.verdict(
        Status.SUCCESS, i, name(int(worst_sphere[i])), f"clear by {float(worst_depth[i]):.3f} m"
    )


def check_dofs(robot: SphereRobot, trajectory: Trajectory) -> None:
    """Raise a TrajectoryError if a trajectory does not fit a robot."""
    if trajectory.num_dofs != robot.num_dofs:
        raise TrajectoryError(
            f"trajectory has {trajectory.num_dofs} joints a waypoint, but the robot has {robot.num_dofs}: "
            f"{', '.join(robot.joint_names)}."
        )


@dataclass(frozen=True)
class _Samples:
    states: Float[Tensor, "m dof"]
    times: Float[Tensor, " m"]
    waypoints: Int[Tensor, " m"]  # at or before each state


@dataclass(frozen=True)
class _Report:
    robot: SphereRobot
    trajectory: Trajectory
    samples: _Samples
    depth: Float[Tensor, " m"]
    gap: Float[Tensor, " m"]

    def verdict(self, status: Status, i: int, link: str, text: str) -> Validation:
        waypoint, time = int(self.samples.waypoints[i]), float(self.samples.times[i])
        where = f"at waypoint {waypoint} of {len(self.trajectory)} (t = {time:.3g} s): "
        return Validation(
            status=status,
            message=where + text.format(link=link),
            clearance=float(self.depth.min()),
            self_clearance=float(self.gap.min()),
            waypoint=waypoint,
            time=time,
            link=link,
            states=len(self.samples.states),
        )


def _sphere_name(robot: SphereRobot) -> Callable[[int], str]:
    """How messages call a sphere: by its link where the robot tells."""
    links = robot.sphere_links if isinstance(robot, LinkedRobot) else None
    return lambda sphere: f"link {links[sphere]}" if links is not None else f"sphere {sphere}"


def _dense_states(robot: SphereRobot, trajectory: Trajectory, config: ValidationConfig) -> _Samples:
    """States dense enough in joint space and, after looking at the spheres, in the workspace."""
    q, n = trajectory.waypoints, len(trajectory)
    if n == 1:
        return _Samples(q, trajectory.times, torch.zeros(1, dtype=torch.long))
    counts = (q.diff(dim=0).abs().amax(dim=1) / config.max_joint_step).ceil().long().clamp_min(1)
    for _ in range(MAX_REFINEMENTS):
        segment = torch.repeat_interleave(torch.arange(n - 1), counts)
        offset = torch.arange(len(segment)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
        weight = (offset / counts[segment]).to(q)
        states = torch.cat([torch.lerp(q[segment], q[segment + 1], weight[:, None]), q[-1:]])
        motion = _sphere_motion(robot, states)
        longest = torch.zeros(n - 1, dtype=motion.dtype).scatter_reduce_(0, segment, motion, "amax")
        if longest.max() <= config.max_step:
            break
        finer = (counts * longest / config.max_step * 1.02).ceil().long()
        counts = torch.where(longest > config.max_step, torch.maximum(finer, counts + 1), counts)
    times = torch.lerp(trajectory.times[segment], trajectory.times[segment + 1], weight.to(trajectory.times))
    waypoints = torch.cat([segment, torch.tensor([n - 1])])
    return _Samples(states, torch.cat([times, trajectory.times[-1:]]), waypoints)


def _sphere_motion(robot: SphereRobot, states: Float[Tensor, "m dof"]) -> Float[Tensor, " m-1"]:
    """Largest motion [m] of any sphere between consecutive states."""
    chunk, motions, kinematics = 2000, [], kinematics_of(robot)
    with torch.no_grad():
        for first in range(0, len(states) - 1, chunk):
            centres = kinematics.centres(states[first : first + chunk + 1])
            motions.append(centres.diff(dim=0).norm(dim=-1).amax(dim=1))
    return torch.cat(motions)


def _measure(
    robot: SphereRobot, workspace: Workspace, states: Float[Tensor, "m dof"], config: ValidationConfig
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"], Float[Tensor, " m"], Int[Tensor, "m 2"]]:
    """Least clearance and its sphere, least self-collision gap and its pair, for every state.

    By the robot's exact shape where it and the field can be compiled, else by its spheres.
    """
    shape = exact_shape(robot, workspace.field, config.workspace)
    if shape is not None:
        return shape.measure(states, config.margin, config.self_margin)
    pairs = robot.self_collision_pairs if isinstance(robot, SelfCollidingRobot) else None
    depths, spheres, gaps, worst = [], [], [], []
    with torch.no_grad():
        for part in states.split(500):
            centres, radii = robot.spheres(part)
            clearance = workspace.clearance(centres, radii)
            # A NaN must win the comparison, whatever the other spheres say.
            depth, sphere = clearance.nan_to_num(nan=-math.inf, posinf=math.inf).min(dim=1)
            depths.append(torch.where(clearance.isnan().any(dim=1), torch.nan, depth))
            spheres.append(sphere)
            if pairs is not None and len(pairs):
                first, second = pairs[:, 0], pairs[:, 1]
                gap = (centres[:, first] - centres[:, second]).norm(dim=-1) - radii[first] - radii[second]
                least, index = gap.min(dim=1)
                gaps.append(least)
                worst.append(pairs[index])
            else:
                gaps.append(torch.full_like(depth, torch.inf))
                worst.append(torch.zeros(len(part), 2, dtype=torch.long))
    return torch.cat(depths), torch.cat(spheres), torch.cat(gaps), torch.cat(worst)


def free_states(
    robot: SphereRobot, workspace: Workspace, states: Float[Tensor, "m dof"], config: ValidationConfig
) -> Bool[Tensor, " m"]:
    """Which states keep the margins from obstacles and from the robot itself; NaN in the field is not free."""
    depth, _, gap, _ = _measure(robot, workspace, states, config)
    return (depth >= config.margin) & (gap >= config.self_margin)


def _first_unknown(
    robot: SphereRobot, workspace: Workspace, states: Float[Tensor, "m dof"]
) -> tuple[int, int]:
    """The first state with a sphere in unknown space, and that sphere; -1 where there is none."""
    kinematics, chunk = kinematics_of(robot), 500
    for first in range(0, len(states), chunk):
        unknown = workspace.unknown(kinematics.centres(states[first : first + chunk]))
        if unknown is not None and unknown.any():
            state, sphere = unknown.nonzero()[0].tolist()
            return first + state, sphere
    return -1, -1


def _limit_excess(robot: SphereRobot, states: Float[Tensor, "m dof"]) -> Float[Tensor, "m dof"]:
    low, high = robot.joint_limits.to(states).unbind(dim=1)
    return torch.maximum(low - states, states - high)


def within_limits(robot: SphereRobot, q: Float[Tensor, "*batch dof"]) -> Bool[Tensor, "*batch"]:
    """Whether configurations keep all joint limits exactly."""
    low, high = robot.joint_limits.to(q).unbind(dim=1)
    return ((q >= low) & (q <= high)).all(dim=-1)
