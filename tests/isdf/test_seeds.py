"""Surface points that are kept from one refresh to the next are those that would be found anew."""

import numpy as np

from isdf import Mapper, MapperConfig
from isdf.mapping import mapper as mapping
from isdf.mapping.bricks import SIDE, BrickVolume
from isdf.mapping.seed_store import ROOM, SeedStore
from isdf.mapping.seeds import kept_seeds, surface_seeds
from tests.isdf.test_visitors import ASIDE, THERE, walking, watch


def assert_as_found_anew(bricks, begin=None, end=None):
    """Returns how many there are."""
    begin = np.zeros(3, dtype=np.int64) if begin is None else begin
    end = np.array(bricks.table.shape) if end is None else end
    kept = kept_seeds(bricks, begin, end)
    assert np.array_equal(kept, surface_seeds(bricks.arrays, begin, end))
    return len(kept)


def test_kept_seeds_are_right_whoever_comes_stands_and_goes(monkeypatch):
    """Before every refresh: after images, people seen from the waist up, and what is taken back."""
    found = []

    def checked(lattice, bricks, box):
        found.append(assert_as_found_anew(bricks))
        return refresh(lattice, bricks, box)

    mapper, refresh = Mapper(MapperConfig(visitors=2.0, refresh_period=0.0)), mapping.refresh
    monkeypatch.setattr(mapping, "refresh", checked)
    high = (*THERE[:2], 1.6)
    watch(mapper, THERE, 1.4)
    watch(mapper, high, 1.0)
    watch(mapper, high, 2.0, walking, height=1.8)
    watch(mapper, ASIDE, 2.6)
    assert len(found) > 35 and min(found) > 1000
    middle = np.array(mapper.bricks.table.shape) // 2
    assert assert_as_found_anew(mapper.bricks, middle - 8, middle + 9) > 0


def plane(height):
    """Eight bricks that meet in a corner, with a surface at this height [voxels]."""
    bricks = BrickVolume(0.02, 100_000)
    bricks.include(np.zeros(3), np.full(3, 0.3))
    bricks.add(np.argwhere(np.ones((2, 2, 2))) - bricks.corner)
    z = 8 * np.array([0, 1] * 4)[:, None] + np.tile(np.arange(SIDE), SIDE**2)
    bricks.distance[:], bricks.weight[:], bricks.ended[:] = 0.02 * (z - height), 1.0, 1.0
    return bricks


def test_a_brick_that_changes_changes_those_beside_it():
    bricks = plane(7.7)  # nearest to the lowest voxels of the upper bricks, for which the lower are needed
    count = assert_as_found_anew(bricks)
    bricks.weight[[0, 2, 4, 6]] = 0
    bricks.changed(np.array([0, 2, 4, 6]))
    assert assert_as_found_anew(bricks) < count


def test_bricks_from_a_file_have_seeds_of_their_own():
    bricks, other = plane(3.2), plane(11.4)
    assert_as_found_anew(bricks)
    bricks.restore(other.table, other.distance, other.weight, other.ended)
    assert assert_as_found_anew(bricks) > 0


def test_a_store_gives_back_what_was_put_last():
    rng, store, expected = np.random.default_rng(0), SeedStore(), {}
    for count in range(10, 300, 10):
        store.fit(count)
        rows = rng.permutation(count)[: count // 2]
        number = rng.integers(0, 60, len(rows))
        seeds = rng.random((number.sum(), 8), dtype=np.float32)
        store.put(rows, number + 7, number, seeds)
        expected |= zip(rows.tolist(), np.split(seeds, np.cumsum(number)[:-1]), strict=True)
        for row in range(count):
            mine = expected.get(row, np.empty((0, 8)))
            assert store.state[row] == (len(mine) + 7 if row in expected else -1)
            assert np.array_equal(store.seeds[store.first[row] :][: store.number[row]], mine)
    used = sum(map(len, expected.values()))
    assert used > ROOM and len(store.seeds) < 6 * used
