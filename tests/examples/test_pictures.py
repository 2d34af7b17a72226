"""The pictures of a report show what they are of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from examples.episode import Episode, EpisodeOptions
from examples.pictures import photo
from examples.summary import clearances
from robots.simulation import Cylinder, SceneField
from robots.simulation.poses import planar_pose


def test_a_photo_from_above_looks_through_the_ceiling() -> None:
    episode = Episode(EpisodeOptions(Path("unused"), "home_1"))
    seen = photo(episode, 160, 120).astype(int)
    before = episode.robot.camera.render()
    assert "ceiling" in episode.world.solids and (before.depth > 0).mean() > 0.9
    episode.close()
    # The sofa is blue; ceiling, walls and floor are not.
    blue = (seen[..., 2] > seen[..., 0] + 20) & (seen[..., 2] > 40)
    assert np.count_nonzero(blue) > 40


def test_how_near_somebody_was_is_told_by_where_he_was_then() -> None:
    wall = Cylinder("column", planar_pose(0.0, 3.0, 0.5), 1.0, 1.0)
    person = Cylinder("person", planar_pose(0.0, 0.0, 0.5), 0.2, 1.0)
    poses = np.stack([planar_pose(x, 0.0, 0.5) for x in (5.0, 1.0, 0.0)])[:, None]
    poses = np.concatenate([poses, poses], axis=1)
    poses[0, 0] = np.nan
    centres, radii = torch.tensor([[[0.0, 0.0, 0.5]]]).expand(3, 1, 3), torch.tensor([0.3])
    told = clearances(SceneField([wall, person]), centres, radii, ("person", "mug of meshes"), poses)
    np.testing.assert_allclose(told, [1.7, 0.5, -0.5], atol=1e-5)
    alone = clearances(SceneField([person]), centres, radii, ("person",), poses[:, :1])
    np.testing.assert_allclose(alone, [np.inf, 0.5, -0.5], atol=1e-5)
