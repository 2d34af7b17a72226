"""The README tells the truth: its snippets run, and the files and commands it names exist."""

import re
from pathlib import Path

import pytest

from isdf.datasets import SequenceWriter
from planning import Status
from tests.isdf.rooms import furnished_orbit

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
URDF = """<robot name="r">
<link name="base"><collision><geometry><box size="0.3 0.2 0.1"/></geometry></collision></link>
<link name="arm"><collision><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.03" length="0.4"/></geometry>
</collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
COMMANDS = re.findall(r"^(?:make|isdf|python -m) .*$", README, flags=re.MULTILINE)


def test_the_first_snippet_maps_and_plans(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    frames = furnished_orbit(12)[:3]
    writer = SequenceWriter("runs/recorded", frames[0].camera, fps=10.0)
    for frame in frames:
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    names: dict = {}
    exec(SNIPPETS[0], names)
    assert names["mapper"].frames_seen == 3
    assert isinstance(names["result"].status, Status) and len(names["result"].trajectory) > 1


def test_the_robot_snippet_fits_and_builds(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_robot.urdf").write_text(URDF)
    names: dict = {}
    exec(SNIPPETS[1], names)
    assert names["robot"].joint_names == ("turn",) and names["report"]


def test_every_make_target_and_module_it_names_exists() -> None:
    makefile = (ROOT / "Makefile").read_text()
    assert COMMANDS
    for command in COMMANDS:
        words = command.split()
        if words[0] == "make":
            assert re.search(rf"^{words[1]}:", makefile, flags=re.MULTILINE), command
        elif words[0] == "python":
            assert (ROOT / (words[2].replace(".", "/") + ".py")).exists(), command


@pytest.mark.parametrize("link", re.findall(r"\]\((?!http)([^)#]+)\)", README))
def test_every_local_link_and_picture_exists(link) -> None:
    assert (ROOT / link).exists()
