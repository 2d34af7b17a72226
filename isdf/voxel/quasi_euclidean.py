"""Quasi-Euclidean distances of a changing TSDF by raise and lower wavefronts (Oleynikova et al., IROS 2017)."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from .volume import GrowingVolume
from .wavefront import END, LENGTHS, neighbours, new_queue, pop, push

# Distances that differ by less are the same [m].
TOLERANCE = 1e-4
UNMAPPED, MAPPED, FIXED = 0, 1, 2
# What `update_distances` needs beside the TSDF. `parent` is 1 + the number of the neighbour a distance came from.
CHANNELS: dict[str, type[np.generic]] = {"esdf": np.float32, "parent": np.uint8, "status": np.uint8}


def update_distances(volume: GrowingVolume, band: float, reach: float) -> None:
    """Bring the channels `esdf`, `parent` and `status` of a volume up to date with `distance`.

    Only voxels whose `changed` is set are looked at for what to raise or lower; it is cleared.

    Args:
        volume: whose TSDF has changed.
        band: voxels within this TSDF distance are fixed [m].
        reach: distances of this size are no longer propagated; what no wave reaches keeps it [m].
    """
    names = ("distance", "changed", "esdf", "parent", "status")
    layers = tuple(volume.channels[name].reshape(-1) for name in names)
    queue = new_queue(layers[0].size, math.ceil(reach / volume.voxel) + 2)
    scales = (volume.voxel, float(band), float(reach))
    raised, count = collect(layers, volume.shape, scales, queue)
    raise_wave(raised, count, layers, volume.shape, scales, queue)
    lower_wave(layers, volume.shape, scales, queue)


@njit(cache=True, nogil=True)
@no_type_check
def collect(layers, shape, scales, queue):
    """Take over what changed in the TSDF; queue what may be lowered, return what must be raised and how many."""
    tsdf, changed, esdf, parent, status = layers
    voxel, band, reach = scales
    raised, count = np.empty(tsdf.size, np.int32), 0
    near = np.empty(26, np.int64)
    for v in range(tsdf.size):
        if not changed[v]:
            continue
        changed[v] = 0
        d = tsdf[v]
        known = status[v]
        if abs(d) <= band:
            if known == FIXED and esdf[v] == d:
                continue
            lowered = known == UNMAPPED or (d >= 0 and esdf[v] > d) or (d < 0 and esdf[v] < d)
            esdf[v], parent[v], status[v] = d, 0, FIXED
            push(queue, v, abs(d) / voxel)
            if not lowered:
                raised[count] = v
                count += 1
        elif known == UNMAPPED:
            esdf[v], parent[v], status[v] = (reach if d >= 0 else -reach), 0, MAPPED
            neighbours(v, shape, near)
            for i in range(26):
                if near[i] != END and status[near[i]] != UNMAPPED:
                    push(queue, near[i], abs(esdf[near[i]]) / voxel)
        elif known == FIXED or (esdf[v] < 0) != (d < 0):
            esdf[v], parent[v], status[v] = (reach if d >= 0 else -reach), 0, MAPPED
            raised[count] = v
            count += 1
    return raised, count


@njit(cache=True, nogil=True)
@no_type_check
def raise_wave(raised, count, layers, shape, scales, queue):
    """Forget every distance that came from a raised one; queue the others that border on them."""
    _, _, esdf, parent, status = layers
    voxel, _, reach = scales
    near = np.empty(26, np.int64)
    done = 0
    while done < count:
        neighbours(raised[done], shape, near)
        done += 1
        for i in range(26):
            n = near[i]
            if n == END or status[n] == UNMAPPED:
                continue
            if parent[n] == 26 - i:
                esdf[n], parent[n] = (reach if esdf[n] >= 0 else -reach), 0
                raised[count] = n
                count += 1
            else:
                push(queue, n, abs(esdf[n]) / voxel)


@njit(cache=True, nogil=True)
@no_type_check
def lower_wave(layers, shape, scales, queue):
    """Let every queued voxel offer its distance plus a step to its neighbours, nearest first, until none gains."""
    _, _, esdf, parent, status = layers
    voxel, _, reach = scales
    near = np.empty(26, np.int64)
    v = pop(queue)
    while v != END:
        d = esdf[v]
        if status[v] != UNMAPPED and abs(d) < reach:
            neighbours(v, shape, near)
            for i in range(26):
                n = near[i]
                if n == END or status[n] != MAPPED:
                    continue
                better, found = _offer(d, esdf[n], LENGTHS[i] * voxel, status[v] == FIXED)
                if found:
                    esdf[n], parent[n] = better, 26 - i
                    if abs(better) < reach:
                        push(queue, n, abs(better) / voxel)
        v = pop(queue)


@njit(cache=True, nogil=True)
@no_type_check
def _offer(mine, other, step, fixed):
    """Distance that a neighbour of distance `other` gets from one of distance `mine`, and whether it is better.

    Within one side of the surface it is nearer by more than the tolerance. Across the surface a fixed distance is
    carried on through zero where the two are more than a step apart, else the neighbour comes down to one step.
    """
    side = 1.0 if mine >= 0 else -1.0
    if (mine >= 0) == (other >= 0):
        better = mine + side * step
        return better, abs(better) + TOLERANCE < abs(other)
    if abs(other + mine) <= step:
        return other, False
    if fixed:
        return mine - side * step, True
    return -side * step, abs(mine) > step and abs(other) > step + TOLERANCE
