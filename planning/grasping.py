"""Grasps for a parallel hand, found in a distance field: antipodal places on an object, with room for the hand.

A grasp closes two fingers along a level line onto faces that look away from each other (Nguyen, "Constructing
force-closure grasps", IJRR 1988); the fingers come level, from above, or from anywhere between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from planning.errors import ConfigError
from planning.object_surface import ObjectSurface
from planning.protocols import ConfidentField, DistanceField
from planning.threads import one_thread


@dataclass(frozen=True, eq=False)
class ParallelHand:
    """An open hand in its tool frame: z along the fingers, y from one finger to the other, the origin between the tips.

    Args:
        centres: (s, 3) of balls that cover hand and fingers [m].
        radii: (s,) [m].
        opening: between the fingers [m].
        tips: how far the fingers reach beyond the origin [m].
    """

    centres: Float[Tensor, "s 3"]
    radii: Float[Tensor, " s"]
    opening: float
    tips: float


POINTS = 1200
"""Of a surface are looked at; more cost time and tell no more."""
FINGER = 0.04
"""What lies this near to the tips is a finger [m]."""
FACE = 0.004
"""What lies within this of a grasp's widest place is the face that a finger closes on [m]."""


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
        hold: least share of a finger's pad that touches the object.
        room: least clearance of the open hand [m]; negative by what the map and the balls may be wrong.
        confidence: where the field knows how sure it is, fingers stay out of space below this: unknown is not free.
        retreat: the hand needs room along its way from this far before the grasp, too [m].
        most: grasps to return.
    """

    headings: int = 36
    pitches: tuple[float, ...] = (0.0, 0.3, 0.7, 1.1, math.pi / 2)
    anchors: int = 48
    bites: tuple[float, ...] = (0.02, 0.035, 0.05)
    pad: float = 0.02
    play: float = 0.006
    antipodal: float = 0.85
    hold: float = 0.5
    room: float = -0.003
    confidence: float = 0.65
    retreat: float = 0.12
    most: int = 40

    def __post_init__(self) -> None:
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
    surface = ObjectSurface(surface.points[drawn], surface.normals[drawn], surface.support)
    anchors = surface.points[: config.anchors]
    found = [
        _along(surface, anchors, turn, hand, bite, config)
        for turn in _turns(config, _yaw(surface))
        for bite in config.bites
    ]
    T, width, antipodal, hold = (torch.cat(parts) for parts in zip(*found, strict=True))
    grasps = Grasps(
        T,
        width,
        antipodal,
        torch.zeros_like(width),
        _score(T, width, antipodal, surface, hand, heading) + 2.0 * hold,
    )
    good = (width <= hand.opening - config.play) & (antipodal >= config.antipodal) & (hold >= config.hold)
    return _with_room(field, grasps.take(good), hand, config)


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
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Poses (k, 4, 4), widths, cosines and holds (k,) of grasps with one rotation, at every anchor.

    A hold is how much of a pad touches the face, by length and width, on the side that has less: at most 1.
    """
    local, normals = surface.points @ turn, surface.normals @ turn
    here = anchors @ turn
    slab = (local[None, :, 0] - here[:, None, 0]).abs() <= config.pad / 2
    slab &= (local[None, :, 1] - here[:, None, 1]).abs() <= hand.opening
    front = local[:, 2].expand(slab.shape).masked_fill(~slab, torch.inf).amin(dim=1)
    window = slab & (local[None, :, 2] <= front[:, None] + bite + 0.01)
    across = local[:, 1].expand(slab.shape)
    low = across.masked_fill(~window, torch.inf).amin(dim=1)
    high = across.masked_fill(~window, -torch.inf).amax(dim=1)
    cosines, holds = [], []
    for facing, near in (
        (normals[:, 1], across >= high[:, None] - FACE),
        (-normals[:, 1], across <= low[:, None] + FACE),
    ):
        face = window & near & (local[None, :, 2] >= front[:, None] + bite - config.pad)
        cosines.append(_mean(facing.expand(slab.shape), face))
        holds.append(_extent(local[:, 2], face, config.pad) * _extent(local[:, 0], face, config.pad))
    origin = torch.stack([here[:, 0], (low + high) / 2, front + bite - hand.tips], dim=1)
    T = torch.eye(4).repeat(len(anchors), 1, 1)
    T[:, :3, :3], T[:, :3, 3] = turn, origin @ turn.T
    return T, high - low, torch.minimum(*cosines), torch.minimum(*holds)


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of each row's values where the mask is set; -1 where it is not at all."""
    count = mask.sum(dim=1)
    mean = values.masked_fill(~mask, 0.0).sum(dim=1) / count.clamp_min(1)
    return mean.where(count > 0, -1.0)


def _extent(values: Tensor, mask: Tensor, most: float) -> Tensor:
    """Range of the values (n,) where each row's mask is set, as a share of `most`, at most 1."""
    rows = values.expand(mask.shape)
    extent = rows.masked_fill(~mask, -torch.inf).amax(dim=1) - rows.masked_fill(~mask, torch.inf).amin(dim=1)
    return (extent / most).clamp(0.0, 1.0)


def _score(
    T: Tensor, width: Tensor, antipodal: Tensor, surface: ObjectSurface, hand: ParallelHand, heading: float
) -> Float[Tensor, " n"]:
    """Opposite faces count most, then being near the middle, play for the fingers, and the robot's side."""
    low, high = surface.points.amin(dim=0), surface.points.amax(dim=0)
    middle = (low + high) / 2
    away = (T[:, :3, 3] - middle) / (high - low).norm()
    beside = away[:, :2].norm(dim=1) + 0.5 * away[:, 2].abs()
    tight = (width / hand.opening - 0.75).clamp_min(0.0)
    towards = T[:, 0, 2] * math.cos(heading) + T[:, 1, 2] * math.sin(heading)
    return 3.0 * antipodal - 0.8 * beside - 0.5 * tight + 0.3 * towards


def _with_room(field: DistanceField, grasps: Grasps, hand: ParallelHand, config: GraspConfig) -> Grasps:
    """The best of those whose open hand is clear at the grasp and on the straight way to it; no two nearly alike."""
    order = grasps.score.argsort(descending=True)[: 40 * config.most]
    grasps = grasps.take(order)
    clearance = hand_clearance(field, grasps.T_world_tool, hand, config.retreat)
    grasps = Grasps(grasps.T_world_tool, grasps.width, grasps.antipodal, clearance, grasps.score)
    grasps = grasps.take((clearance >= config.room) & _seen(field, grasps.T_world_tool, hand, config))
    return grasps.take(_different(grasps.T_world_tool, config.most))


def hand_clearance(
    field: DistanceField, T_world_tool: Float[Tensor, "n 4 4"], hand: ParallelHand, retreat: float
) -> Float[Tensor, " n"]:
    """Least clearance [m] of an open hand at poses and on the straight ways to them, `retreat` [m] long."""
    clearance = torch.full((len(T_world_tool),), torch.inf)
    for back in torch.linspace(0.0, retreat, 4).tolist():
        local = hand.centres - torch.tensor([0.0, 0.0, back])
        for block in torch.arange(len(T_world_tool)).split(256):
            T = T_world_tool[block]
            centres = local @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
            gaps = (field.distance(centres) - hand.radii).amin(dim=1)
            clearance[block] = torch.minimum(clearance[block], gaps)
    return clearance


def _seen(
    field: DistanceField, T: Float[Tensor, "n 4 4"], hand: ParallelHand, config: GraspConfig
) -> Bool[Tensor, " n"]:
    """Where both fingers are in seen space: behind an object may be more of it. All, if the field cannot tell."""
    if not isinstance(field, ConfidentField):
        return torch.ones(len(T), dtype=torch.bool)
    fingers = hand.centres[hand.centres[:, 2] > -FINGER]
    known = field.confidence(fingers @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]) >= config.confidence
    sides = [known[:, side].float().mean(dim=1) for side in (fingers[:, 1] > 0, fingers[:, 1] < 0)]
    return torch.minimum(*sides) > 0.75


def _different(T: Float[Tensor, "n 4 4"], most: int) -> Bool[Tensor, " n"]:
    """The first of those that lie within a centimetre and 15 degrees of each other, at most so many."""
    kept = torch.zeros(len(T), dtype=torch.bool)
    for i in range(len(T)):
        near = (T[kept, :3, 3] - T[i, :3, 3]).norm(dim=1) < 0.01
        alike = (T[kept, :3, :3] * T[i, :3, :3]).sum(dim=(1, 2)) > 1 + 2 * math.cos(math.radians(15.0))
        kept[i] = int(kept.sum()) < most and not bool((near & alike).any())
    return kept
