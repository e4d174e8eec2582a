"""Blocks of a lattice's cells by an octree: a node is halved along all axes until it holds few enough points.

A block is a leaf of the tree: neighbouring cells, as many as share one node. Cells come in the order of their Morton
codes (the bits of the three numbers, interleaved), in which every node of the tree is one stretch; so do the points,
which can then lie in a file, block after block.
Source: Morton, A computer oriented geodetic data base (1966).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Int

BITS = 21
"""Of a cell's number along an axis: three of them make one code of 64 bits."""

Codes = npt.NDArray[np.uint64]

_SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3))
_LAST = (2, 0x1249249249249249)


def morton(cells: Int) -> Codes:
    """Return the Morton codes, of shape (N,), of cells of shape (N, 3), each number from 0 and below 2^21."""
    x, y, z = (_spread(cells[:, axis].astype(np.uint64)) for axis in range(3))
    codes: Codes = (x << np.uint64(2)) | (y << np.uint64(1)) | z
    return codes


def _spread(numbers: Codes) -> Codes:
    """Set two zeros between all bits of each number."""
    for shift, mask in (*_SPREAD, _LAST):
        numbers = (numbers | (numbers << np.uint64(shift))) & np.uint64(mask)
    return numbers


def octree_blocks(codes: Codes, counts: Int, most: int) -> list[slice]:
    """Return the leaves of the octree, in order, as slices of the cells.

    Parameters
    ----------
    codes : of shape (C,), the cells' Morton codes, ascending
    counts : of shape (C,), points in each cell
    most : points up to which a node is not halved; a single cell may hold more
    """
    before = np.concatenate([[0], np.cumsum(counts)])
    blocks: list[slice] = []
    # Children go onto the stack last first, so that leaves come off it in order.
    nodes = [(0, len(codes), BITS)] if len(codes) else []
    while nodes:
        first, last, bits = nodes.pop()
        if bits == 0 or last - first == 1 or before[last] - before[first] <= most:
            blocks.append(slice(first, last))
            continue
        octants = (codes[first:last] >> np.uint64(3 * (bits - 1))) & np.uint64(7)
        ends = first + np.searchsorted(octants, np.arange(9, dtype=np.uint64))
        nodes += [(int(a), int(b), bits - 1) for a, b in zip(ends[-2::-1], ends[:0:-1], strict=True) if b > a]
    return blocks
