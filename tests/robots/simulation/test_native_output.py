"""Loading a scene without masses prints nothing; what pybullet says of it is in the log."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from robots.errors import SceneError
from robots.simulation import World, load_urdf_scene
from robots.simulation.native_output import logged_instead

BOX = '<collision><geometry><box size="1 1 1"/></geometry></collision>'


def test_a_scene_without_masses_loads_quietly(
    tmp_path: Path, capfd, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "hall.urdf"
    path.write_text(f'<robot name="hall"><link name="floor">{BOX}</link></robot>')
    with caplog.at_level(logging.DEBUG, "robots.simulation.world"):
        World(load_urdf_scene(path)).close()
    out, err = capfd.readouterr()
    assert "inertial" not in out + err
    assert "No inertial data" in caplog.text


def test_what_is_printed_comes_back_after_an_error(tmp_path: Path, capfd) -> None:
    with pytest.raises(ValueError, match="broken"), logged_instead(logging.getLogger("nobody")):
        os.write(1, b"hidden")
        raise ValueError("broken")
    os.write(1, b"shown")
    assert capfd.readouterr().out == "shown"
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot>")
    with pytest.raises(SceneError, match="pybullet cannot load"):
        World(load_urdf_scene(broken))
