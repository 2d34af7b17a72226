"""A table's top that an image cuts off goes on flat, until free space behind it proves that it ends."""

import numpy as np
import pytest

from isdf.mapping.continuation import continued

SHAPE = (24, 12, 12)
EDGE, TOP = 8, 5.5
"""What was seen of the top ends at x = 8 nodes; it lies at z = 5.5."""


def top_seen_to_the_edge(behind_is_free=False):
    """What `continued` says where x > EDGE, of a top at z = TOP that was seen as far as that from above."""
    x, y = np.meshgrid(np.arange(0, EDGE + 0.1, 0.25), np.arange(0, 11.1, 0.25), indexing="ij")
    places = np.stack([x.ravel(), y.ravel(), np.full(x.size, TOP)], axis=1)
    seeds = np.concatenate([places, np.tile([0.0, 0.0, 1.0], (x.size, 1))], axis=1).astype(np.float32)
    i, j, k = np.indices(SHAPE)
    nodes = np.stack([i, j, k], axis=-1).astype(np.float32)
    free = (k > TOP) | (behind_is_free & (i > EDGE))
    # The closest of the seeds is beside the node, or at the edge.
    away = nodes - np.stack([np.minimum(i, EDGE), j, np.full(SHAPE, TOP)], axis=-1)
    upper = np.linalg.norm(away, axis=-1).astype(np.float32)
    nearest = (4 * np.minimum(i, EDGE) * len(np.arange(0, 11.1, 0.25)) + 4 * j).astype(np.int32)
    np.testing.assert_allclose(seeds[nearest, :3] + away, nodes, atol=1e-6)
    return continued(seeds, nearest, upper, np.where(free, 0, -upper).astype(np.float32), free), nodes, upper


def test_the_plane_is_as_far_as_nodes_lie_off_it_and_its_foot_as_far_as_they_lie_beside_what_was_seen():
    out, nodes, _ = top_seen_to_the_edge()
    np.testing.assert_allclose(out[0], nodes[..., 2] - TOP, atol=1e-5)
    np.testing.assert_allclose(out[1], np.maximum(nodes[..., 0] - EDGE, 0), atol=1e-5)


@pytest.mark.parametrize("above", [True, False])
def test_a_distance_that_takes_that_share_of_the_gap_is_the_planes(above):
    out, nodes, upper = top_seen_to_the_edge()
    here = (nodes[..., 2] > TOP) if above else (nodes[..., 2] < TOP)
    lower = 0 if above else -upper
    np.testing.assert_allclose(
        (upper - (upper - lower) * out[2])[here], (nodes[..., 2] - TOP)[here], atol=1e-5
    )


def test_it_goes_on_where_nobody_looked_behind_it_and_ends_where_somebody_did():
    beside, foot = slice(3, 5), slice(5, 7)
    within = (slice(EDGE + 1, -1), slice(1, -1), slice(7, -1))
    hidden, seen_past = (top_seen_to_the_edge(behind)[0] for behind in (False, True))
    for place in (beside, foot):
        behind, before = hidden[place]
        assert behind[within].max() < 0.3 and before[within].min() > 0.9
        behind, before = seen_past[place]
        assert before[within].min() > 0.9
        assert behind[within].min() > 0.6
    # Where the foot is seen itself, what is behind is hidden by it.
    assert seen_past[5][1 : EDGE - 1, 1:-1, 7:-1].max() < 0.3


def test_nothing_is_said_where_nothing_is_left_to_guess():
    seeds = np.array([[0, 0, 0, 0, 0, 1]], dtype=np.float32)
    nearest, free = np.zeros((3, 3, 3), dtype=np.int32), np.ones((3, 3, 3), dtype=bool)
    upper = np.linalg.norm(np.indices((3, 3, 3)), axis=0).astype(np.float32)
    assert (continued(seeds, nearest, upper, upper - 0.05, free) == 0).all()
    assert (continued(seeds, nearest, upper + 30, upper, free) == 0).all()
    assert (continued(seeds, nearest, upper, upper - 0.5, free)[0, ..., 2] == 2).all()


def test_a_leaning_plane_is_measured_along_its_own_normal():
    normal = np.array([2.0, -1.0, 2.0]) / 3
    along = np.array([1.0, 2.0, 0.0]) / np.sqrt(5)
    seeds = np.array([[6, 6, 6, *normal]], dtype=np.float32)
    offsets = np.indices((13, 13, 13)).reshape(3, -1).T - 6
    upper = np.linalg.norm(offsets, axis=1).reshape(13, 13, 13).astype(np.float32)
    free = (offsets @ normal > 0).reshape(upper.shape)
    free |= (offsets @ along > 3).reshape(upper.shape)
    out = continued(seeds, np.zeros(upper.shape, dtype=np.int32), upper, 0 * upper, free)
    asked = (upper > 1).ravel()
    off = offsets @ normal
    foot = offsets - off[:, None] * normal
    planes = out.reshape(len(out), -1)
    np.testing.assert_allclose(planes[0, asked], off[asked], atol=1e-5)
    np.testing.assert_allclose(planes[1, asked], np.linalg.norm(foot, axis=1)[asked], atol=1e-4)
    within = asked & (np.abs(foot).max(axis=1) < 5)
    past, short = within & (foot @ along > 4), within & (foot @ along < 1)
    assert past.sum() > 20 and planes[5, past].min() > 0.9
    assert short.sum() > 20 and planes[5, short].max() < 0.6 and np.mean(planes[5, short]) < 0.2
