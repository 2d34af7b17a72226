"""Maps grow to hold what is seen, and refuse what does not fit numbers or memory."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from isdf import FrameError, Mapper, MapperConfig
from isdf.mapping.bricks import BrickVolume
from isdf.mapping.lattice import Lattice
from isdf.voxel.volume import GrowingVolume
from tests.isdf.rooms import furnished_orbit

GROWING = {
    "voxels": lambda edge: GrowingVolume(edge, {"a": np.float32}, 1 << 20),
    "bricks": lambda edge: BrickVolume(edge, 1 << 20),
    "lattice": Lattice,
}


@pytest.mark.parametrize("kind", GROWING)
@pytest.mark.parametrize(
    ("edge", "low", "high"), [(1e-30, -1.0, 1.0), (0.1, -1e25, -9e24), (0.1, 0.0, np.inf), (0.1, -1e4, 1e4)]
)
def test_boxes_beyond_all_numbers_are_refused_without_a_trace(kind, edge, low, high) -> None:
    volume = GROWING[kind](0.1)
    volume.include(np.zeros(3), np.ones(3))
    before = volume.nbytes
    volume = GROWING[kind](edge) if edge != 0.1 else volume
    with warnings.catch_warnings(), pytest.raises(FrameError, match="this frame would make the map"):
        warnings.simplefilter("error", RuntimeWarning)
        volume.include(np.full(3, low), np.full(3, high))
    assert volume.nbytes <= before


def test_a_truncation_longer_than_the_depth_stays_before_the_camera() -> None:
    mapper = Mapper(MapperConfig(truncation_noise=1.0))
    for frame in furnished_orbit(12)[:2]:
        mapper.integrate(frame)
    assert mapper.frames_seen == 2
    eye = furnished_orbit(12)[0].T_world_camera[:3, 3].float()
    assert mapper.field().distance(eye) > 0.1 and torch.isfinite(mapper.bounds).all()
