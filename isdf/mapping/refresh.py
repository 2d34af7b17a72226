"""Bringing the lattice up to date in a window: guesses by the network, then distances by the seeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from .backs import unseen_backs
from .bricks import BrickVolume
from .completion import STRIDE, CompletionNet, features
from .evidence import Evidence, bounds, gather
from .lattice import FINE, Lattice, in_units
from .nearest import finer_nearest
from .patches import Patches, in_cubes
from .refinement import cells_to_refine, middle_values, near_known, refined_values
from .seeds import kept_seeds
from .standing import vertical
from .values import Window, coarse_values

# Surfaces this far outside a window still count in it [m].
MARGIN = 2.5
# Box in which distances are guessed: half its sides across and along the vertical [m], and at most so many nodes, so
# that the network of a fine lattice takes no more memory and time than that of the default one.
GUESS_ACROSS, GUESS_ALONG = 4.48, 2.56
NODES_ACROSS, NODES_ALONG = 28, 16

Box = Float[np.ndarray, "2 3"]


@dataclass(frozen=True)
class Surroundings:
    """What is proven in a box, turned as the network knows it: the vertical is the last axis, upwards.

    Args:
        proven: of the box's nodes.
        corner: lattice index of the first of them, along the network's axes.
        begin: first node of the box, as array index of the lattice.
        end: one past its last.
        order: axis of the lattice for each of the network's.
        upside_down: the lattice's vertical axis points down.
    """

    proven: Evidence
    corner: Int[np.ndarray, "3"]
    begin: Int[np.ndarray, "3"]
    end: Int[np.ndarray, "3"]
    order: list[int]
    upside_down: bool

    def in_lattice(self, answer: np.ndarray) -> np.ndarray:
        """An answer of the network along the lattice's axes."""
        return (answer[:, :, ::-1] if self.upside_down else answer).transpose(np.argsort(self.order))


def middle_of_guesses(
    eye: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"], bounds: Box, spacing: float
) -> Float[np.ndarray, "3"]:
    """The middle of the box to guess in [m]: as near to the camera as it can be and hold all of what was seen.

    So a room that fits into the box is guessed as a whole, wherever in it the camera is. Where more was seen than fits,
    the box lies within it.

    Args:
        eye: the camera's position [m].
        up: any vector whose largest component tells the vertical; along it the box has its middle at the eye.
        bounds: of what was seen [m].
        spacing: of the lattice [m].
    """
    (axis, _), reach = vertical(up), _reach(up, spacing)
    first, last = np.sort([bounds[0] + reach, bounds[1] - reach], axis=0)
    middle = np.clip(eye, first, last)
    middle[axis] = eye[axis]
    return middle


def _reach(up: Float[np.ndarray, "3"], spacing: float) -> Float[np.ndarray, "3"]:
    """Half the sides [m] of the box in which distances are guessed."""
    reach = np.full(3, min(GUESS_ACROSS, NODES_ACROSS * spacing))
    reach[vertical(up)[0]] = min(GUESS_ALONG, NODES_ALONG * spacing)
    return reach


def surroundings(
    lattice: Lattice, bricks: BrickVolume, middle: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> Surroundings | None:
    """What the network goes by; None where there is nothing. Arguments as for `guess`."""
    (axis, way), reach = vertical(up), _reach(up, lattice.spacing)
    begin, end = lattice.window(middle - reach, middle + reach)
    upside_down = way < 0
    # What is too much for the network is cut off at the top, wherever that is: turned worlds give the same window.
    spare = (end - begin) % STRIDE
    below = np.where((np.arange(3) == axis) & upside_down, spare, 0)
    begin, end = begin + below, end - (spare - below)
    seeds = kept_seeds(bricks, *bricks.box(middle - reach - MARGIN, middle + reach + MARGIN))[:, :3]
    if len(seeds) == 0 or (end <= begin).any():
        return None
    order = [across for across in range(3) if across != axis] + [axis]
    evidence, corner, seeds = (
        lattice.read("evidence", begin, end).transpose(order),
        (lattice.corner + begin)[order],
        seeds[:, order],
    )
    if upside_down:
        evidence, seeds = evidence[:, :, ::-1], seeds * np.array([1, 1, -1], dtype=np.float32)
        corner[2] = -(corner[2] + evidence.shape[2] - 1)
    proven = gather(np.ascontiguousarray(seeds), np.ascontiguousarray(evidence), corner, lattice.spacing)
    return Surroundings(proven, corner, begin, end, order, upside_down)


def guess(
    lattice: Lattice,
    bricks: BrickVolume,
    network: CompletionNet,
    middle: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
) -> Box | None:
    """Run the network in a box and keep its answers in the lattice.

    Args:
        lattice: its `share` and `width` are changed.
        bricks: the surfaces.
        network: on any device.
        middle: of the box [m], see `middle_of_guesses`.
        up: any vector whose largest component tells the vertical and its sign the way up.

    Returns:
        The box [m] that is to be refreshed, or None where there was nothing to go by.
    """
    around = surroundings(lattice, bricks, middle, up)
    if around is None:
        return None
    share, width = (around.in_lattice(answer) for answer in _run(network, features(around.proven)))
    begin, end = around.begin, around.end
    lattice.write(begin, end, share=share, width=width)
    return lattice.spacing * np.stack([lattice.corner + begin, lattice.corner + end - 1])


def _run(network: CompletionNet, x: Tensor) -> tuple[np.ndarray, np.ndarray]:
    device = next(network.parameters()).device
    with torch.no_grad():
        share, width = network(x[None].to(device))
    return share[0].cpu().numpy(), width[0].cpu().numpy()


def refresh(lattice: Lattice, bricks: BrickVolume, box: Box) -> bool:
    """Write the distances and confidences in a box [m] anew; False while there is no surface to measure from."""
    begin, end = lattice.window(box[0], box[1])
    low, high = (lattice.spacing * (lattice.corner + n) for n in (begin, end))
    seeds = kept_seeds(bricks, *bricks.box(low - MARGIN, high + MARGIN))
    if len(seeds) == 0:
        return False
    seeds = np.concatenate([seeds, unseen_backs(seeds, bricks.arrays, lattice.arrays)])
    centre = seeds[:, :3]
    evidence = lattice.read("evidence", begin, end)
    proven = bounds(centre, evidence, lattice.corner + begin, lattice.spacing)
    window = Window(
        first=lattice.corner + begin,
        ratio=FINE - 1,
        step=lattice.spacing / (FINE - 1),
        voxels=round(lattice.spacing / (FINE - 1) / bricks.voxel),
        evidence=evidence,
        upper=proven.upper,
        lower=proven.lower,
        share=lattice.read("share", begin, end).astype(np.float32),
        width=lattice.read("width", begin, end).astype(np.float32),
        value=np.empty(proven.lower.shape, dtype=np.float32),
        confidence=np.empty(proven.lower.shape, dtype=np.uint8),
        state=np.empty(proven.lower.shape, dtype=np.int8),
        taken=np.empty(proven.lower.shape, dtype=np.float32),
        block=lattice.read("block", begin, end),
    )
    # Nearest seeds are found for every second fine node; the others choose among those of a cell.
    where = near_known(window, bricks.arrays)
    places = (centre / np.float32(lattice.spacing / 2) - 2 * window.first).astype(np.float32)
    nearest = finer_nearest(places, proven.nearest, where)
    patches = Patches(seeds, nearest, *in_cubes(places, where.shape))
    coarse_values(window, patches, bricks.arrays)
    line, miss = middle_values(window, patches, bricks.arrays, where)
    refine, stale = np.zeros_like(window.block, dtype=np.bool_), np.zeros_like(window.block, dtype=np.bool_)
    cells_to_refine(window, line, miss, lattice.corrections, refine, stale)
    # The window's last nodes belong to cells that reach out of it: those stay as they are.
    inner = np.zeros_like(refine)
    inner[:-1, :-1, :-1] = True
    written = inner & refine & ((window.block < 0) | stale)
    lattice.reassign(window.block, written, inner & ~refine)
    refined_values(window, patches, bricks.arrays, miss, np.argwhere(written), lattice.corrections)
    value = in_units(window.value)
    lattice.write(begin, end, value=value, confidence=window.confidence, block=window.block)
    return True
