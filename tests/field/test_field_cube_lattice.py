"""The lattice of a partition: cubes that overlap share its nodes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gnrecon.field.cube_lattice import NodeGrid, cube_groups, equal_rows
from gnrecon.field.partition_of_unity import Partition

CELLS = Partition(np.array([0.3, -1.0, 2.0]), 0.7)


def nodes_of(grid: NodeGrid, key: tuple[int, int, int]) -> np.ndarray:
    """The nodes in a cube, in the order of its blocks."""
    lattice = grid.lattice
    nodes = (lattice.corners[:, None] + lattice.offsets).reshape(-1, 3) + CELLS.center(key)
    return nodes[grid.inside]


@pytest.mark.parametrize("step", [0.3, 0.1, 0.0771, 0.0499])
def test_a_cube_has_all_nodes_within_it_and_no_others(step: float) -> None:
    grid, key = NodeGrid.of(CELLS, step), (2, -1, 0)
    assert 0.5 * step < grid.step <= step
    count = grid.count
    every = np.array(list(itertools.product(*(range(k * count - count, k * count + 2 * count) for k in key))))
    places = grid.places(every)
    within = (np.abs(places - CELLS.center(key)) <= CELLS.reach * (1 + 1e-9)).all(axis=1)
    found = nodes_of(grid, key)
    assert len(found) == within.sum()
    np.testing.assert_allclose(sorted(map(tuple, found.round(9))), sorted(map(tuple, places[within].round(9))))


def test_neighbours_share_the_nodes_where_they_overlap() -> None:
    grid = NodeGrid.of(CELLS, 0.08)
    one, other = ({tuple(node) for node in nodes_of(grid, key).round(9)} for key in ((0, 0, 0), (1, 0, 0)))
    middle = CELLS.center((0, 0, 0))[0] + CELLS.cell / 2
    shared = {node for node in one if node[0] > middle - CELLS.overlap / 2 * CELLS.cell}
    assert 0 < len(shared) < len(one)
    assert one & other == shared


def test_values_at_nodes_are_in_the_order_of_the_blocks() -> None:
    grid = NodeGrid.of(CELLS, 0.1)
    first, size = grid.first(np.array([0, 0, 0])), grid.blocks * grid.block
    nodes = first + np.stack(np.meshgrid(*3 * [np.arange(size)], indexing="ij"), axis=-1)
    lattice = grid.lattice
    expected = (lattice.corners[:, None] + lattice.offsets).reshape(-1, 3) + CELLS.center((0, 0, 0))
    for axis in range(3):
        np.testing.assert_allclose(grid.by_blocks(grid.places(nodes)[..., axis]), expected[:, axis], atol=1e-12)


@pytest.mark.parametrize("stride", [1, 2])
def test_nodes_are_found_in_their_blocks(stride: int, rng: np.random.Generator) -> None:
    grid = NodeGrid.of(CELLS, 0.1)
    nodes = stride * rng.integers(-20, 20, (100, 3))
    centers, offsets, block, inner = grid.in_blocks(nodes, stride)
    assert offsets.shape == (grid.block**3, 3)
    assert len(centers) == len({tuple(node) for node in (nodes // (grid.block * stride)).tolist()})
    np.testing.assert_allclose(centers[block] + offsets[inner], grid.places(nodes), atol=1e-12)


def test_groups_are_boxes_of_cells() -> None:
    keys = np.array([[-1, -1, -1], [2, 2, 2], [3, 2, 2], [0, 0, 0], [-1, 3, 0], [6, 2, 2]])
    groups = cube_groups(keys, 4)
    assert sorted(map(sorted, map(np.ndarray.tolist, groups))) == [[0, 1, 3], [2, 5], [4]]
    assert cube_groups(np.zeros((0, 3), dtype=np.int64), 4) == []


def test_equal_rows_keep_their_order(rng: np.random.Generator) -> None:
    values = rng.integers(-3, 3, (300, 3))
    found = equal_rows(values)
    assert sorted(np.concatenate(found)) == list(range(300))
    assert len(found) == len({tuple(row) for row in values.tolist()})
    for rows in found:
        assert (values[rows] == values[rows[0]]).all()
        assert (np.diff(rows) > 0).all()
