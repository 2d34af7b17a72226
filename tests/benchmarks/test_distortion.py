"""What is taken for a camera's true distortion, and images freed of it."""

from types import SimpleNamespace

import numpy as np
import torch

from benchmarks.distortion import Freed, true_distortion
from isdf import DepthFrame, PinholeCamera

CAMERA = PinholeCamera(60.0, 60.0, 39.5, 29.5, 80, 60)
RELATIVE = 0.01 * np.sin(np.linspace(0, 3, 80)) * np.ones((60, 1))


class Sequence(list):
    camera, folder, poses, fps = CAMERA, None, None, 10.0


def sequences():
    """Exact images, and the same with a distortion and, in a corner, an edge that has moved."""
    rng = np.random.default_rng(0)
    exact, noisy = Sequence(), Sequence()
    for _ in range(20):
        depth = torch.from_numpy(rng.uniform(1, 3, (60, 80))).float()
        measured = depth * torch.from_numpy(1 + RELATIVE).float()
        measured[:5, :5] += 1.0
        exact.append(DepthFrame(depth, np.eye(4), CAMERA))
        noisy.append(DepthFrame(measured, np.eye(4), CAMERA))
    return noisy, exact


def test_the_truth_is_the_mean_ratio_of_the_depths_less_its_mean():
    found = true_distortion(*sequences())
    np.testing.assert_allclose(found[10:], (RELATIVE - RELATIVE.mean())[10:], atol=2e-4)
    assert np.abs(found[:5, :5]).max() < 0.01


def test_a_freed_sequence_is_the_same_without_the_distortion():
    noisy, exact = sequences()
    freed = Freed(noisy, SimpleNamespace(relative=lambda height, width: RELATIVE))
    assert len(freed) == 20 and freed.fps == 10.0 and freed.camera is CAMERA
    torch.testing.assert_close(freed[3].depth[10:], exact[3].depth[10:])
    assert freed[3].time == noisy[3].time
