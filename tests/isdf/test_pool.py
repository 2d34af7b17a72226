"""Snapshots of a lattice share its memory: none changes, nothing is copied, and what they held is used again."""

import numpy as np
import pytest

from isdf import FrameError
from isdf.mapping.lattice import CHUNK, FAR, UNIT, Lattice, in_units


class Reader:
    """Holds what a field would."""

    def __init__(self, lattice: Lattice) -> None:
        self.table, self.value = lattice.table.copy(), lattice.nodes.arrays["value"]
        lattice.readers.add(self)

    def read(self) -> np.ndarray:
        return self.value[self.table[self.table >= 0]].copy()


def lattice_of(side: float) -> Lattice:
    lattice = Lattice(0.16)
    lattice.include(np.zeros(3), np.full(3, side))
    return lattice


def fill(lattice: Lattice, begin: int, end: int, value: float) -> None:
    window = np.full((end - begin,) * 3, value)
    lattice.write(np.full(3, begin), np.full(3, end), value=in_units(window))


def test_what_was_written_is_read_across_chunks_and_nothing_else():
    lattice = lattice_of(4.0)
    rng, begin, end = np.random.default_rng(0), np.array([3, 6, 1]), np.array([12, 9, 17])
    window = in_units(rng.normal(size=tuple(end - begin)))
    lattice.write(begin, end, value=window)
    whole = lattice.read("value", np.zeros(3, dtype=int), np.array(lattice.shape))
    inner = tuple(slice(b, e) for b, e in zip(begin, end, strict=True))
    np.testing.assert_array_equal(whole[inner], window)
    whole[inner] = FAR / UNIT
    assert (whole == FAR / UNIT).all()
    assert (lattice.read("block", begin, end) == -1).all()
    lattice.include(np.full(3, -3.0), np.zeros(3))  # the box grows downwards: the nodes stay where they are
    moved = lattice.read("value", begin - lattice.corner, end - lattice.corner)
    np.testing.assert_array_equal(moved, window)


def test_distances_are_kept_to_an_eighth_of_a_millimetre_and_those_of_halls_cut_off():
    distances = np.array([[[-9.0, -0.3, 0.0, 0.12345, 8.0, 20.0]]])
    kept = UNIT * in_units(distances)[0, 0].astype(float)
    assert np.abs(kept - distances[0, 0])[1:5].max() <= UNIT / 2
    assert kept[[0, 5]] == pytest.approx([-8.19175, 8.19175])


def test_a_snapshot_never_changes_while_the_map_goes_on():
    lattice = lattice_of(4.0)
    fill(lattice, 0, 20, 2.0)
    readers = []
    for value in (3.0, 4.0, 5.0):
        reader = Reader(lattice)
        readers.append((reader, reader.read()))
        fill(lattice, 0, 12, value)
        lattice.include(np.zeros(3), np.full(3, 4.0 + 2 * value))  # and grows
        fill(lattice, 30, 30 + int(value), value)
    for reader, before in readers:
        np.testing.assert_array_equal(reader.read(), before)


def test_rows_that_no_snapshot_holds_are_used_again():
    lattice = lattice_of(4.0)
    fill(lattice, 0, 24, 2.0)
    rows = []
    held = Reader(lattice)
    for n in range(40):
        fill(lattice, 0, 24, 0.2 * n)
        held = Reader(lattice)
        rows.append(len(lattice.nodes.arrays["value"]))
    assert held.read().min() == round(7.8 / UNIT)
    assert rows[-1] == rows[2]
    assert lattice.nodes.used == 27


def test_without_snapshots_nothing_is_copied():
    lattice = lattice_of(4.0)
    fill(lattice, 0, 24, 2.0)
    before = lattice.table.copy()
    fill(lattice, 0, 24, 3.0)
    np.testing.assert_array_equal(lattice.table, before)


def test_blocks_of_corrections_are_not_written_while_read():
    lattice = lattice_of(2.0)
    block, every = np.full((2, 2, 2), -1, dtype=np.int32), np.ones((2, 2, 2), dtype=bool)
    lattice.reassign(block, every, ~every)
    assert len(np.unique(block)) == 8
    held, old = Reader(lattice), block.copy()
    lattice.reassign(block, every, ~every)
    assert not np.isin(block, old).any()
    del held
    lattice.reassign(block, every, ~every)
    assert lattice.cells.used == 8
    lattice.reassign(block, ~every, every)
    assert lattice.cells.used == 0 and (block == -1).all()


def test_distances_in_metres_are_not_cut_to_whole_units():
    lattice = lattice_of(2.0)
    with pytest.raises(TypeError, match=r"float64.*int16"):
        lattice.write(np.zeros(3, dtype=int), np.full(3, 4), value=np.full((4, 4, 4), 0.7))
    assert lattice.nodes.used == 0


def test_memory_follows_what_was_written_and_not_the_box_about_it():
    lattice = lattice_of(2.0)
    fill(lattice, 0, 8, 2.0)
    before = lattice.nbytes
    lattice.include(np.zeros(3), np.array([60.0, 60.0, 3.0]))
    assert lattice.nbytes < before + 40_000
    end = (np.array(lattice.shape) // CHUNK - 1) * CHUNK
    lattice.write(end, end + CHUNK, value=in_units(np.zeros((CHUNK,) * 3)))
    assert lattice.nodes.used == 2
    with pytest.raises(FrameError, match="chunks"):
        lattice.include(np.zeros(3), np.full(3, 900.0))
