"""What a real camera and its localisation do wrong: lost or black frames, a pose that jumps, an image that hangs."""

import logging
import math

import numpy as np
import pytest
import torch

from isdf import DepthFrame, FrameError, Mapper, PinholeCamera
from tests.isdf.rooms import SDF, box, furnished_room, look_at, render, union

CAMERA = PinholeCamera.from_fov(80, 60, math.radians(70))
FPS = 10.0
JUMPS = ((0.3, 0, 0), (-0.3, 0, 0), (0, 0.3, 0), (0, -0.3, 0), (0, 0, 0.3))


def drive(count: int, sdf: SDF | None = None) -> list[DepthFrame]:
    """A robot drives through the room, looking down at the floor before it as robots do."""
    frames = []
    for n in range(count):
        eye = (-1.3 + 0.05 * n, -1.4 + 0.01 * n, 1.2)
        frames.append(
            render(sdf or furnished_room(), look_at(eye, (eye[0] + 0.7, eye[1] + 0.6, 0.5)), CAMERA, n / FPS)
        )
    return frames


@pytest.fixture(scope="module")
def frames() -> list[DepthFrame]:
    return drive(28)


@pytest.fixture(scope="module")
def points(frames) -> torch.Tensor:
    seen = torch.cat([frame.thinned(4, 10.0) for frame in frames])
    generator = torch.Generator().manual_seed(0)
    chosen = seen[torch.randint(len(seen), (2000,), generator=generator)]
    eye = frames[14].T_world_camera[:3, 3].float()
    return eye + torch.rand(2000, 1, generator=generator) * (chosen - eye)


def error_of(mapper: Mapper, points: torch.Tensor) -> float:
    mapper.refresh()
    distance = mapper.field().distance(points)
    assert torch.isfinite(distance).all()
    return float((distance - furnished_room()(points)).abs().mean())


@pytest.fixture(scope="module")
def untroubled(frames, points) -> float:
    mapper = Mapper()
    for frame in frames:
        mapper.integrate(frame)
    assert mapper.frames_skipped == 0
    return error_of(mapper, points)


def moved(frame: DepthFrame, by: tuple[float, float, float]) -> DepthFrame:
    """The frame with a pose that has jumped."""
    T = frame.T_world_camera.clone()
    T[:3, 3] += torch.tensor(by, dtype=T.dtype)
    return DepthFrame(frame.depth, T, frame.camera, frame.time)


@pytest.mark.parametrize("jump", JUMPS)
def test_every_jump_of_one_frame_by_30_cm_over_a_floor_is_noticed(frames, points, untroubled, caplog, jump):
    mapper = Mapper()
    with caplog.at_level(logging.WARNING):
        for n, frame in enumerate(frames):
            mapper.integrate(moved(frame, jump) if n == 12 else frame)
    assert mapper.frames_skipped == 1
    assert caplog.text.count("at 1.20 s") == 1 and "a jump of the pose? passed over" in caplog.text
    assert error_of(mapper, points) < 1.05 * untroubled


def test_a_jump_that_lasts_is_believed(frames):
    mapper = Mapper()
    for n, frame in enumerate(frames):
        mapper.integrate(moved(frame, (0.0, 0.0, 0.3)) if n >= 12 else frame)
    assert 1 <= mapper.frames_skipped <= 6
    assert mapper.frames_seen >= 22


def test_fast_motion_and_turns_are_no_jumps(frames):
    mapper = Mapper()
    for n in (0, 1, 2, 8, 9, 20, 21, 6, 27):  # the camera is thrown about, but its poses are true
        frame = frames[n]
        mapper.integrate(
            DepthFrame(frame.depth, frame.T_world_camera, frame.camera, float(mapper.frames_seen) / FPS)
        )
    for n in range(4):  # and turns on the spot by 20 degrees a frame
        angle = -0.3 + 0.35 * n
        pose = look_at((0, -1.1, 1.2), (math.cos(angle), -1.1 + math.sin(angle), 0.6))
        mapper.integrate(render(furnished_room(), pose, CAMERA, 1.0 + n / FPS))
    assert mapper.frames_skipped == 0


def test_a_thing_put_into_view_is_no_jump(frames):
    mapper = Mapper()
    for frame in frames[:10]:
        mapper.integrate(frame)
    cart = union(furnished_room(), box((-0.1, -0.4, 0.4), (0.5, 0.5, 0.8)))
    for frame in drive(20, cart)[10:]:
        mapper.integrate(frame)
    assert mapper.frames_skipped == 0


@pytest.mark.parametrize("nod", (0.01, 0.3))
def test_somebody_who_steps_before_the_camera_is_no_jump_even_while_it_nods(frames, nod):
    mapper = Mapper()
    for frame in frames[:10]:
        mapper.integrate(frame)
    eye, at = (-0.8, -1.3, 1.2), (-0.1, -0.7, 0.5)  # as in the last of them
    for n in range(12):  # across the line of sight, until he hides more than half of what there is to see
        x, y = -0.45 + 0.03 * (11 - n), -0.95 - 0.04 * (11 - n)
        room = union(furnished_room(), box((x, y, 0.7), (0.4, 0.4, 1.4)))
        pose = look_at(eye, (*at[:2], at[2] + nod * (n % 2)))
        mapper.integrate(render(room, pose, CAMERA, 1.0 + n / FPS))
    assert mapper.frames_skipped == 0


def test_somebody_before_a_camera_that_glances_about_is_no_jump(frames):
    mapper = Mapper()
    for frame in frames[:10]:
        mapper.integrate(frame)
    eye = (-0.8, -1.3, 1.2)
    for n in range(12):  # every other image shows nothing of what the last one showed
        x, y = -0.45 + 0.03 * (11 - n), -0.95 - 0.04 * (11 - n)
        room = union(furnished_room(), box((x, y, 0.7), (0.4, 0.4, 1.4)))
        angle = math.atan2(0.6, 0.7) + 1.3 * (n % 2)
        # The camera sits beside the axis that it turns about.
        at = np.array([math.cos(angle), math.sin(angle)])
        pose = look_at((*(eye[:2] + 0.1 * at), eye[2]), (*(eye[:2] + at), 0.5))
        mapper.integrate(render(room, pose, CAMERA, 1.0 + n / FPS))
    assert mapper.frames_skipped == 0


def test_lost_and_black_frames_and_an_image_that_hangs_do_little_harm(frames, points, untroubled, caplog):
    rng, mapper, refused = np.random.default_rng(1), Mapper(), 0
    lost = set(rng.choice(np.arange(1, 28), 3, replace=False).tolist())
    black = set(rng.choice([n for n in range(1, 28) if n not in lost], 2, replace=False).tolist())
    with caplog.at_level(logging.WARNING):
        for n, frame in enumerate(frames):
            if n in lost:
                continue
            if n in black:
                with pytest.raises(FrameError, match="no valid pixel"):
                    mapper.integrate(
                        DepthFrame(torch.zeros(60, 80), frame.T_world_camera, CAMERA, frame.time)
                    )
                refused += 1
                continue
            # From 1.5 s to 1.9 s the image stands still while the robot drives on.
            hangs = 15 <= n < 19 and 15 not in lost | black
            mapper.integrate(
                DepthFrame(
                    frames[15].depth if hangs else frame.depth, frame.T_world_camera, CAMERA, frame.time
                )
            )
    assert refused == 2
    assert caplog.text.count("hangs") == 1 and caplog.text.count("is back") == 1
    assert mapper.frames_skipped >= 1
    assert error_of(mapper, points) < min(0.0073, 1.2 * untroubled)
