"""A first path where a straight line will not do: RRT-Connect on batched field queries, then shortcuts.

RRT-Connect: Kuffner and LaValle, ICRA 2000. Each round grows a tree towards a whole batch of samples and
tests all edges in one query of the spheres, so that the field, and not Python, is what takes time.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from planning.errors import ConfigError, TrajectoryError
from planning.exact_shape import exact_shape
from planning.numbers import refuse_nan
from planning.protocols import CostField, DistanceField, SelfCollidingRobot, SphereRobot
from planning.validation import within_limits
from planning.workspace import Workspace, WorkspaceConfig

logger = logging.getLogger(__name__)

STATES_AT_ONCE = 2000
WIDE_RANGE = (
    4 * math.pi
)  # [rad | m] of a joint above which all of it is no use to sample, as of a base in a hall


@dataclass(frozen=True)
class RrtConfig:
    """How the search samples and when it gives up.

    Args:
        margin: clearance [m] that every state of the path keeps, unless start or goal have less.
        min_margin: clearance [m] that start and goal must have; the margin becomes theirs where they are
            tighter.
        self_margin: gap [m] that self-collision pairs keep.
        batch: samples grown towards in one round.
        connections: of the nodes added in a round, how many (the nearest to the other tree) are tried to
            connect.
        reach: longest edge of a round, as the motion [m] of the sphere that moves most.
        resolution: motion [m] of that sphere between two states tested on an edge.
        unlimited_range: joints without limits, or with very wide ones, are sampled this far [rad | m] beyond start
            and goal.
        goal_bias: share of the samples that are the root of the other tree.
        shortcut_rounds: batches of random shortcuts tried on the path.
        max_nodes: nodes of both trees after which the search gives up.
        seconds: wall time [s] after which the search gives up.
        candidates: paths found and shortened, of which the shortest is taken; only where robot and field can be
            compiled, since a path then costs milliseconds. How many there is time for depends on the machine; with
            one, the seed alone decides.
        workspace: rules for the floor and for unknown space, which counts as blocked.
    """

    margin: float = 0.01
    min_margin: float = 0.0
    self_margin: float = 0.0
    batch: int = 32
    connections: int = 8
    reach: float = 0.5
    resolution: float = 0.02
    unlimited_range: float = 3.0
    goal_bias: float = 0.1
    shortcut_rounds: int = 60
    max_nodes: int = 20_000
    seconds: float = 10.0
    candidates: int = 3
    workspace: WorkspaceConfig = field(default_factory=WorkspaceConfig)

    def __post_init__(self) -> None:
        refuse_nan(self)
        if not (0 < self.resolution <= self.reach) or self.batch < 1:
            raise ConfigError(
                f"RrtConfig: 0 < resolution <= reach and batch >= 1 are needed, got "
                f"resolution={self.resolution:g} m, reach={self.reach:g} m, batch={self.batch}."
            )


@dataclass(frozen=True)
class NoPath:
    """The search found nothing, and why."""

    message: str


def rrt_connect(
    robot: SphereRobot,
    sdf: DistanceField | CostField,
    start: Float[Tensor, " dof"],
    goal: Float[Tensor, " dof"],
    config: RrtConfig | None = None,
    seed: int = 0,
) -> Float[Tensor, "k dof"] | NoPath:
    """Find a collision-free path from start to goal, shortened by random shortcuts; compiled where possible.

    Returns:
        (k, dof) vertices joined by free straight edges, first and last exactly start and goal; or NoPath.

    Raises:
        TrajectoryError: if start or goal does not fit the robot.
    """
    config = config or RrtConfig()
    for name, q in (("start", start), ("goal", goal)):
        if len(q) != robot.num_dofs:
            raise TrajectoryError(f"rrt_connect: {name} has {len(q)} joints, the robot has {robot.num_dofs}.")
    shape = exact_shape(robot, sdf, config.workspace)
    deadline = time.perf_counter() + config.seconds
    if shape is not None:
        from planning.exact_search import search

        return search(shape, start, goal[None], config, seed, deadline)
    space = StateSpace(robot, sdf, start, goal, config)
    for name, q in (("start", start), ("goal", goal)):
        if not space.free(q[None])[0]:
            return NoPath(
                f"{name} is blocked: in collision, in unknown space, out of limits or within "
                f"{config.min_margin:g} m of an obstacle"
            )
    generator = torch.Generator().manual_seed(seed)
    path = _grow(space, start, goal, generator, deadline)
    if isinstance(path, NoPath):
        return path
    return shortcut(space, path, generator, deadline)


class StateSpace:
    """The configurations of a robot, with a metric in metres and batched tests of states and edges.

    Joints are weighted by the most that any sphere was seen to move per unit of theirs, so lengths are in
    metres. The 1-norm of a weighted step practically bounds the motion of every sphere: edges are divided by
    it. Nearness and length of a path are measured by the 2-norm.
    """

    def __init__(
        self,
        robot: SphereRobot,
        sdf: DistanceField | CostField,
        start: Float[Tensor, " dof"],
        goal: Float[Tensor, " dof"],
        config: RrtConfig,
    ) -> None:
        self.robot, self.config = robot, config
        self.workspace = Workspace(robot, sdf, eps=1.0, config=config.workspace)
        low, high = robot.joint_limits.to(start).unbind(dim=1)
        wide = high - low > WIDE_RANGE
        least, most = torch.minimum(start, goal), torch.maximum(start, goal)
        self.low = torch.where(wide, torch.maximum(low, least - config.unlimited_range), low)
        self.high = torch.where(wide, torch.minimum(high, most + config.unlimited_range), high)
        with torch.no_grad():
            ends = self.workspace.clearance(*robot.spheres(torch.stack([start, goal])))
        tightest = float(ends.min().nan_to_num(config.min_margin))
        self.margin = max(config.min_margin, min(config.margin, tightest))
        self.weights = self._motion_per_joint(
            torch.lerp(start, goal, torch.tensor([[0.0], [0.5], [1.0]]).to(start))
        )

    def _motion_per_joint(self, at: Float[Tensor, "k dof"]) -> Float[Tensor, " dof"]:
        """Largest motion of a sphere per unit of each joint, over given and a few random configurations."""
        generator = torch.Generator().manual_seed(0)
        at = torch.cat([at, self.sample(13, generator)])
        step = 1e-2
        with torch.no_grad():
            before, _ = self.robot.spheres(at)
            after, _ = self.robot.spheres(at[:, None] + step * torch.eye(self.robot.num_dofs).to(at))
        motion = (after - before[:, None]).norm(dim=-1) / step
        return motion.amax(dim=(0, 2)).clamp_min(1e-3)

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count dof"]:
        """Uniform configurations."""
        uniform = torch.rand(count, self.robot.num_dofs, generator=generator).to(self.low)
        return self.low + (self.high - self.low) * uniform

    def motion(self, step: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch"]:
        """Bound [m] on the motion of any sphere over joint-space steps."""
        return (step.abs() * self.weights).sum(-1)

    def length(self, step: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch"]:
        """Length [m] of joint-space steps."""
        return (step * self.weights).norm(dim=-1)

    def nearest(self, nodes: Float[Tensor, "n dof"], to: Float[Tensor, "k dof"]) -> Int[Tensor, " k"]:
        """Index of the node nearest to each configuration."""
        return torch.cdist(to * self.weights, nodes * self.weights).argmin(dim=1)

    def free(self, q: Float[Tensor, "k dof"]) -> Bool[Tensor, " k"]:
        """Which configurations keep limits and margins, in known space; NaN in the field is not free."""
        with torch.no_grad():
            centres, radii = self.robot.spheres(q)
        free = (self.workspace.clearance(centres, radii) >= self.margin).all(dim=-1) & within_limits(
            self.robot, q
        )
        unknown = self.workspace.unknown(centres)
        if unknown is not None:
            free &= ~unknown.any(dim=-1)
        if free.any() and isinstance(self.robot, SelfCollidingRobot) and len(self.robot.self_collision_pairs):
            first, second = self.robot.self_collision_pairs.unbind(dim=1)
            centres = centres[free]
            gap = (centres[:, first] - centres[:, second]).norm(dim=-1) - radii[first] - radii[second]
            free[free.clone()] = (gap >= self.config.self_margin).all(dim=-1)
        return free

    def advance(self, start: Float[Tensor, "k dof"], end: Float[Tensor, "k dof"]) -> Float[Tensor, " k"]:
        """How far each straight edge is free from its start on, as a fraction: 1 if all of it is.

        States are tested coarsely first, then ever more finely, but none beyond the first that is known to be
        blocked: most of a blocked edge is never looked at.
        """
        counts = (self.motion(end - start) / self.config.resolution).ceil().long().clamp_min(1)
        edge = torch.repeat_interleave(torch.arange(len(start)), counts)
        rank = torch.arange(len(edge)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts) + 1
        first_blocked = counts + 1
        untested = torch.ones_like(edge, dtype=torch.bool)
        for stride in (16, 4, 1):
            now = untested & (rank < first_blocked[edge]) & ((rank % stride == 0) | (rank == counts[edge]))
            untested &= ~now
            e, r = edge[now], rank[now]
            states = torch.lerp(start[e], end[e], (r / counts[e]).to(start)[:, None])
            free = torch.cat([self.free(part) for part in states.split(STATES_AT_ONCE)])
            first_blocked = first_blocked.scatter_reduce(0, e[~free], r[~free], "amin")
        return ((first_blocked - 1) / counts).to(start)


class _Tree:
    """Nodes with their parents; the root is node 0 and its own parent."""

    def __init__(self, root: Float[Tensor, " dof"], capacity: int) -> None:
        self._nodes = root.new_empty(capacity, len(root))
        self._parents = torch.zeros(capacity, dtype=torch.long)
        self._nodes[0] = root
        self.size = 1

    @property
    def nodes(self) -> Float[Tensor, "n dof"]:
        return self._nodes[: self.size]

    def add(self, nodes: Float[Tensor, "k dof"], parents: Int[Tensor, " k"]) -> Int[Tensor, " k"]:
        end = self.size + len(nodes)
        self._nodes[self.size : end], self._parents[self.size : end] = nodes, parents
        indices = torch.arange(self.size, end)
        self.size = end
        return indices

    def branch(self, node: int) -> Float[Tensor, "k dof"]:
        """From the root to a node."""
        indices = [node]
        while indices[-1] != 0:
            indices.append(int(self._parents[indices[-1]]))
        return self._nodes[indices[::-1]]


def _grow(
    space: StateSpace,
    start: Float[Tensor, " dof"],
    goal: Float[Tensor, " dof"],
    generator: torch.Generator,
    deadline: float,
) -> Float[Tensor, "k dof"] | NoPath:
    """Grow two trees in turn: towards samples, and from what was added towards the other tree."""
    config = space.config
    if space.advance(start[None], goal[None])[0] == 1:
        return torch.stack([start, goal])
    here, there = (_Tree(root, config.max_nodes + 2 * config.batch) for root in (start, goal))
    while here.size + there.size < config.max_nodes:
        if time.perf_counter() > deadline:
            return NoPath(f"no path found in {config.seconds:g} s ({here.size + there.size} nodes)")
        samples = space.sample(config.batch, generator)
        biased = torch.rand(config.batch, generator=generator) < config.goal_bias
        samples[biased] = there.nodes[0]
        parents = space.nearest(here.nodes, samples)
        nodes, parents = _extend(space, here.nodes[parents], samples, parents)
        if len(nodes):
            added = here.add(nodes, parents)
            targets = space.nearest(there.nodes, nodes)
            gaps = space.length(there.nodes[targets] - nodes)
            nearest = gaps.argsort()[: config.connections]
            nodes, added, targets = nodes[nearest], added[nearest], targets[nearest]
            reached = space.advance(nodes, there.nodes[targets])
            if (reached == 1).any():
                i = int((reached == 1).nonzero()[0])
                path = torch.cat([here.branch(int(added[i])), there.branch(int(targets[i])).flip(0)])
                return path if torch.equal(path[0], start) else path.flip(0)
            partly = reached > 0
            here.add(torch.lerp(nodes, there.nodes[targets], reached[:, None])[partly], added[partly])
        here, there = there, here
    return NoPath(f"no path found with {config.max_nodes} nodes")


def _extend(
    space: StateSpace,
    origin: Float[Tensor, "k dof"],
    samples: Float[Tensor, "k dof"],
    parents: Int[Tensor, " k"],
) -> tuple[Float[Tensor, "m dof"], Int[Tensor, " m"]]:
    """New nodes as far towards the samples as is free and within reach, with their parents."""
    reach = (space.config.reach / space.motion(samples - origin).clamp_min(1e-9)).clamp_max(1.0)
    ends = torch.lerp(origin, samples, reach[:, None])
    free = space.advance(origin, ends)
    moved = free > 0
    return torch.lerp(origin, ends, free[:, None])[moved], parents[moved]


def shortcut(
    space: StateSpace, path: Float[Tensor, "k dof"], generator: torch.Generator, deadline: float
) -> Float[Tensor, "shorter dof"]:
    """Replace stretches of a free path by straight edges where these are free and shorter.

    Each round draws pairs of points and of vertices along the path and takes the free shortcut that saves
    most.
    """
    for _ in range(space.config.shortcut_rounds):
        if len(path) == 2 or time.perf_counter() > deadline:
            break
        arc = torch.cat([path.new_zeros(1), space.length(path.diff(dim=0)).cumsum(0)])
        anywhere = torch.rand(5, 2, generator=generator).to(arc) * arc[-1]
        vertices = arc[torch.randint(len(arc), (5, 2), generator=generator)]
        ends = torch.cat([anywhere, vertices]).sort(dim=1).values
        segment = torch.searchsorted(arc, ends, right=True).clamp_max(len(arc) - 1) - 1
        weight = ((ends - arc[segment]) / (arc[segment + 1] - arc[segment]).clamp_min(1e-12)).clamp(0, 1)
        points = torch.lerp(path[segment], path[segment + 1], weight.unsqueeze(-1))
        saved = (ends[:, 1] - ends[:, 0]) - space.length(points[:, 1] - points[:, 0])
        useful = (saved > 1e-6).nonzero()[:, 0]
        if len(useful) == 0:
            continue
        segment, points, saved = segment[useful], points[useful], saved[useful]
        saved = torch.where(space.advance(points[:, 0], points[:, 1]) == 1, saved, -torch.inf)
        best = int(saved.argmax())
        if torch.isfinite(saved[best]):
            first, last = segment[best].tolist()
            path = torch.cat([path[: first + 1], points[best], path[last + 1 :]])
            distinct = torch.cat([torch.tensor([True]), space.length(path.diff(dim=0)) > 0])
            path = path[distinct]
    return path
