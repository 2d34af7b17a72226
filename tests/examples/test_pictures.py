"""The pictures of a report show what they are of."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from examples.episode import Episode, EpisodeOptions
from examples.pictures import photo


def test_a_photo_from_above_looks_through_the_ceiling() -> None:
    episode = Episode(EpisodeOptions(Path("unused"), "home_1"))
    seen = photo(episode, 160, 120).astype(int)
    before = episode.robot.camera.render()
    assert "ceiling" in episode.world.solids and (before.depth > 0).mean() > 0.9
    episode.close()
    # The sofa is blue; ceiling, walls and floor are not.
    blue = (seen[..., 2] > seen[..., 0] + 20) & (seen[..., 2] > 40)
    assert np.count_nonzero(blue) > 40
