"""Grasps for a parallel hand, found in a distance field: antipodal places on an object, with room for the hand.

A grasp closes two fingers along a level line onto faces that look away from each other (Nguyen, "Constructing
force-closure grasps", IJRR 1988); the fingers come level, from above, or from anywhere between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from planning.errors import ConfigError
from planning.hand_room import ParallelHand, RoomRound
from planning.numbers import refuse_nan
from planning.object_surface import ObjectSurface
from planning.protocols import DistanceField
from planning.threads import one_thread

POINTS = 1200
"""Of a surface are looked at; more cost time and tell no more."""
FACE = 0.004
"""What lies within this of a grasp's widest place is the face that a finger closes on [m]."""
OUTLIERS = 2
"""So many points on either side of a grasp may stick out, and are noise."""
ROUNDING = 1e-5
"""Bites that are as deep as the support allows end so far below that [m], at most."""
SHALLOW = 0.006
"""Fingers that reach less far over an object [m] hold nothing."""
LEVER = 8.0
"""What a grasp's score loses for each metre that it is away from the middle."""
UNSEEN = 1.5
"""What a grasp's score loses if a finger is in unseen space altogether."""


@dataclass(frozen=True)
class GraspConfig:
    """Which grasps are looked for.

    Args:
        headings: directions round the object from which the hand may come.
        pitches: angles [rad] by which the fingers point down.
        anchors: points of the object that the fingers close at.
        bites: how deep the fingers reach over the object [m].
        pad: width of a finger's face [m].
        play: least difference between opening and object [m].
        antipodal: least mean cosine between a face's normals and the closing line.
        square: the same for the face's mean normal seen along the fingers: a finger can lie against a face that slopes
            a little, and maps round the edges of what is flat, but a face that is turned pushes the thing away.
        hold: least share of a finger's pad, as far as it reaches over the object, that touches it.
        above: the hand stays so far over the support [m], by what the map and the arm may be wrong.
        room: least clearance of the open hand [m]; negative by what the map and the balls may be wrong.
        seen: least share of each finger that is in space that was seen: unknown is not free.
        retreat: the hand needs room along its way from this far before the grasp, too [m].
        most: grasps to return.
    """

    headings: int = 36
    pitches: tuple[float, ...] = (0.0, 0.3, 0.7, 1.1, math.pi / 2)
    anchors: int = 48
    bites: tuple[float, ...] = (0.012, 0.02, 0.035, 0.05)
    pad: float = 0.02
    play: float = 0.006
    antipodal: float = 0.7
    square: float = 0.92
    hold: float = 0.5
    above: float = 0.004
    room: float = -0.003
    seen: float = 0.3
    retreat: float = 0.12
    most: int = 40

    def __post_init__(self) -> None:
        refuse_nan(self)
        if min(self.headings, self.anchors, self.most, self.pad) <= 0 or not (self.pitches and self.bites):
            raise ConfigError(
                f"GraspConfig: headings, anchors, most and pad must be positive, pitches and bites given, got {self}."
            )


@dataclass(frozen=True, eq=False)
class Grasps:
    """Ranked grasps, the best first.

    Args:
        T_world_tool: (n, 4, 4) [m].
        width: (n,) of the object between the fingers [m].
        antipodal: (n,) the lesser mean cosine between a face's normals and the closing line.
        clearance: (n,) of the open hand [m].
        score: (n,) what they are ranked by.
    """

    T_world_tool: Float[Tensor, "n 4 4"]
    width: Float[Tensor, " n"]
    antipodal: Float[Tensor, " n"]
    clearance: Float[Tensor, " n"]
    score: Float[Tensor, " n"]

    def __len__(self) -> int:
        return len(self.width)

    def take(self, rows: Tensor) -> Grasps:
        """Some of them, by number or mask."""
        return Grasps(*(value[rows] for value in vars(self).values()))


@one_thread
def find_grasps(
    field: DistanceField,
    surface: ObjectSurface,
    hand: ParallelHand,
    heading: float = 0.0,
    config: GraspConfig | None = None,
    seed: int = 0,
) -> Grasps:
    """Find grasps of an object, the best first; there may be none.

    Args:
        field: the map, for the room that the open hand needs.
        surface: of the object.
        hand: that takes it.
        heading: [rad] from the robot to the object; grasps from the robot's side are preferred.
        config: see `GraspConfig`.
        seed: of the anchors.
    """
    config = config or GraspConfig()
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randperm(len(surface.points), generator=generator)[:POINTS]
    surface = replace(surface, points=surface.points[drawn], normals=surface.normals[drawn])
    anchors = surface.points[: config.anchors]
    found = [
        _along(surface, anchors, turn, hand, bite, config)
        for turn in _turns(config, _yaw(surface))
        for bite in config.bites
    ]
    T, width, antipodal, hold, depth = (torch.cat(parts) for parts in zip(*found, strict=True))
    grasps = Grasps(
        T,
        width,
        antipodal,
        torch.zeros_like(width),
        _score(T, width, antipodal, surface, hand, heading) + 3.0 * hold * depth,
    )
    good = (width <= hand.opening - config.play) & (antipodal >= config.antipodal) & (hold >= config.hold)
    return _with_room(RoomRound(field, surface), grasps.take(good), hand, config)


def _yaw(surface: ObjectSurface) -> float:
    """Heading [rad] of the narrowest upright box round an object: boxes are gripped square, or not at all."""
    angles = torch.arange(0, 90, 2) * (math.pi / 180)
    axes = torch.stack([angles.cos(), angles.sin()], dim=1)
    spans = [
        surface.points[:, :2] @ turned.T for turned in (axes, torch.stack([-axes[:, 1], axes[:, 0]], dim=1))
    ]
    ends = torch.tensor([0.02, 0.98])
    sides = [span.quantile(ends, dim=0).diff(dim=0)[0] for span in spans]
    return float(angles[(sides[0] * sides[1]).argmin()])


def _turns(config: GraspConfig, yaw: float) -> Float[Tensor, "t 3 3"]:
    """Rotations of the tool: fingers (z) along a heading and down by a pitch, closing line (y) level."""
    psi = yaw + torch.arange(config.headings) * (2 * math.pi / config.headings)
    theta = torch.tensor(config.pitches)
    psi, theta = (grid.reshape(-1) for grid in torch.meshgrid(psi, theta, indexing="ij"))
    cos, sin, zero = psi.cos(), psi.sin(), torch.zeros_like(psi)
    z = torch.stack([cos * theta.cos(), sin * theta.cos(), -theta.sin()], dim=1)
    y = torch.stack([-sin, cos, zero], dim=1)
    return torch.stack([torch.linalg.cross(y, z), y, z], dim=2)


def _along(
    surface: ObjectSurface,
    anchors: Tensor,
    turn: Tensor,
    hand: ParallelHand,
    bite: float,
    config: GraspConfig,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Poses (k, 4, 4), widths, cosines, holds and depths (k,) of grasps with one rotation, at every anchor.

    A hold is how much of a pad touches the face, by length and width, on the side that has less: at most 1; a
    depth is how much of a pad reaches over the object. Fingers reach less far where they would come too near to its
    support.
    """
    local, normals = surface.points @ turn, surface.normals @ turn
    here = anchors @ turn
    slab = (local[None, :, 0] - here[:, None, 0]).abs() <= config.pad / 2
    slab &= (local[None, :, 1] - here[:, None, 1]).abs() <= hand.opening
    front = local[:, 2].expand(slab.shape).masked_fill(~slab, torch.inf).amin(dim=1)
    deep = front + _bite(here[:, 0], front, turn, surface.support + config.above, hand, bite)
    window = slab & (local[None, :, 2] <= deep[:, None] + 0.01)
    across = local[:, 1].expand(slab.shape)
    low = _outermost(across, window)
    high = -_outermost(-across, window)
    length = (deep - front).clamp(SHALLOW, config.pad)
    cosines, squares, holds = [], [], []
    for facing, near in (
        (normals[:, 1], across >= high[:, None] - FACE),
        (-normals[:, 1], across <= low[:, None] + FACE),
    ):
        face = window & near & (local[None, :, 2] >= deep[:, None] - config.pad)
        mean = _mean(facing.expand(slab.shape), face)
        cosines.append(mean)
        squares.append(mean / mean.hypot(_mean(normals[:, 0].expand(slab.shape), face)).clamp_min(1e-6))
        holds.append(
            _extent(local[:, 2], face) / length * (_extent(local[:, 0], face) / config.pad).clamp_max(1.0)
        )
    origin = torch.stack([here[:, 0], (low + high) / 2, deep - hand.tips], dim=1)
    T = torch.eye(4).repeat(len(anchors), 1, 1)
    T[:, :3, :3], T[:, :3, 3] = turn, origin @ turn.T
    fits = (deep - front >= SHALLOW) & (torch.minimum(*squares) >= config.square)
    hold = torch.minimum(*holds).clamp_max(1.0).where(fits, 0.0)
    return T, high - low, torch.minimum(*cosines), hold, length / config.pad


def _bite(
    across: Tensor, front: Tensor, turn: Tensor, floor: float, hand: ParallelHand, bite: float
) -> Float[Tensor, " k"]:
    """How deep the fingers reach over an object from its front (k,) [m] to end above a height `floor` [m]."""
    down = -float(turn[2, 2])
    if down < 0.2:  # level fingers come no higher by reaching less far
        return torch.full_like(front, bite)
    tool = turn[2, 0] * across + turn[2, 2] * (front + bite - hand.tips)
    return bite - (floor - (tool - hand.below(turn))).clamp_min(0.0) / down


def _outermost(values: Tensor, mask: Tensor) -> Float[Tensor, " k"]:
    """The least of each row's values where the mask is set, but for a few that may be wrong."""
    return values.masked_fill(~mask, torch.inf).topk(OUTLIERS + 1, dim=1, largest=False).values[:, -1]


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of each row's values where the mask is set; -1 where it is not at all."""
    count = mask.sum(dim=1)
    mean = values.masked_fill(~mask, 0.0).sum(dim=1) / count.clamp_min(1)
    return mean.where(count > 0, -1.0)


def _extent(values: Tensor, mask: Tensor) -> Tensor:
    """Range of the values (n,) where each row's mask is set, 0 where it is not at all."""
    rows = values.expand(mask.shape)
    extent = rows.masked_fill(~mask, -torch.inf).amax(dim=1) - rows.masked_fill(~mask, torch.inf).amin(dim=1)
    return extent.clamp_min(0.0)


def _score(
    T: Tensor, width: Tensor, antipodal: Tensor, surface: ObjectSurface, hand: ParallelHand, heading: float
) -> Float[Tensor, " n"]:
    """Opposite faces count, being near the middle, where weight does not turn the thing in the hand, play for the
    fingers, and the robot's side.
    """
    away = T[:, :3, 3] - surface.middle
    beside = away[:, :2].norm(dim=1) + 0.3 * away[:, 2].abs()
    tight = (width / hand.opening - 0.75).clamp_min(0.0)
    towards = T[:, 0, 2] * math.cos(heading) + T[:, 1, 2] * math.sin(heading)
    return 5.0 * antipodal - LEVER * beside - 0.5 * tight + 0.3 * towards


def _with_room(room: RoomRound, grasps: Grasps, hand: ParallelHand, config: GraspConfig) -> Grasps:
    """The best of those whose open hand is clear at the grasp and on the straight way to it; no two nearly alike."""
    T = grasps.T_world_tool
    above = T[:, 2, 3] - hand.below(T[:, :3, :3]) - room.surface.support
    grasps = grasps.take(above >= config.above - ROUNDING)
    grasps = grasps.take(grasps.score.argsort(descending=True)[: 40 * config.most])
    seen = room.seen_share(grasps.T_world_tool, hand)
    grasps = replace(grasps, score=grasps.score - UNSEEN * (1 - seen)).take(seen >= config.seen)
    grasps = grasps.take(grasps.score.argsort(descending=True))
    clearance = room.clearance(grasps.T_world_tool, hand, config.retreat)
    grasps = replace(grasps, clearance=clearance).take(clearance >= config.room)
    return grasps.take(_different(grasps.T_world_tool, config.most))


def _different(T: Float[Tensor, "n 4 4"], most: int) -> Bool[Tensor, " n"]:
    """The first of those that lie within a centimetre and 15 degrees of each other, at most so many."""
    kept = torch.zeros(len(T), dtype=torch.bool)
    for i in range(len(T)):
        near = (T[kept, :3, 3] - T[i, :3, 3]).norm(dim=1) < 0.01
        alike = (T[kept, :3, :3] * T[i, :3, :3]).sum(dim=(1, 2)) > 1 + 2 * math.cos(math.radians(15.0))
        kept[i] = int(kept.sum()) < most and not bool((near & alike).any())
    return kept
