"""Octree blocks: Morton codes against interleaved bits, and leaves that are whole nodes of the tree."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gnrecon.geometry.octree import MORTON_BITS, morton_codes, octree_blocks


def interleaved(cell: tuple[int, int, int]) -> int:
    code = 0
    for bit in reversed(range(MORTON_BITS)):
        for number in cell:
            code = 2 * code + (number >> bit & 1)
    return code


cells = st.tuples(*3 * [st.integers(0, 2**MORTON_BITS - 1)])


@given(st.lists(cells, min_size=1, max_size=20))
def test_codes_are_the_interleaved_bits(found: list[tuple[int, int, int]]) -> None:
    assert morton_codes(np.array(found, dtype=np.int64)).tolist() == [interleaved(cell) for cell in found]


@given(st.sets(st.tuples(*3 * [st.integers(0, 30)]), min_size=1, max_size=60), st.integers(1, 40), st.data())
def test_leaves_are_nodes_that_hold_few_points(
    found: set[tuple[int, int, int]], most: int, data: st.DataObject
) -> None:
    codes = np.sort(morton_codes(np.array(sorted(found), dtype=np.int64)))
    counts = np.array([data.draw(st.integers(0, 50)) for _ in codes])
    blocks = octree_blocks(codes, counts, most)
    assert [row for block in blocks for row in range(block.start, block.stop)] == list(range(len(codes)))
    for block in blocks:
        inside = counts[block].sum()
        assert inside <= most or block.stop - block.start == 1
        # The smallest node that holds a leaf's cells holds no others.
        low, high = int(codes[block.start]), int(codes[block.stop - 1])
        levels = next(n for n in range(MORTON_BITS + 1) if low >> 3 * n == high >> 3 * n)
        assert [int(code) >> 3 * levels == low >> 3 * levels for code in codes].count(True) == len(codes[block])


def test_no_cells_make_no_blocks() -> None:
    assert octree_blocks(np.zeros(0, dtype=np.uint64), np.zeros(0, dtype=np.int64), 5) == []


def test_a_tree_that_fits_is_one_block() -> None:
    codes = morton_codes(np.array([[0, 0, 0], [5, 1, 2], [7, 7, 7]]))
    assert octree_blocks(np.sort(codes), np.array([3, 3, 4]), 10) == [slice(0, 3)]
