"""Poses of cameras that look somewhere."""

import numpy as np

from robots.simulation.poses import looking


def test_a_camera_looks_where_it_is_told_and_stands_upright() -> None:
    for forward in ([1.0, 0.0, 0.0], [0.3, -2.0, -0.7], [-1.0, 1.0, 3.0]):
        T = looking((1.0, 2.0, 3.0), forward)
        right, down, ahead, eye = T[:3].T
        np.testing.assert_allclose(eye, [1.0, 2.0, 3.0])
        np.testing.assert_allclose(ahead, forward / np.linalg.norm(forward))
        assert abs(right[2]) < 1e-12 and down[2] < 0
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) > 0 and (T[3] == [0, 0, 0, 1]).all()
