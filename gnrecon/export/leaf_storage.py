"""Node values of the leaves that were evaluated, and the signs of all others, in memory that grows with the surface.

A leaf is a block of 4 cells a side, a chunk one of 8 leaves a side. An index names the table of each chunk, and a table
the row of each of its leaves in a store of values. Tables and rows 0 and 1 stand for what is wholly outside and wholly
inside; a chunk has a table of its own only where its leaves differ. The entry is `LeafStore`.
"""

from __future__ import annotations

import itertools
from enum import IntEnum
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from gnrecon.export.export_parameters import ExportParameters
from gnrecon.geometry.arrays import Int, Mask

Rows = npt.NDArray[np.int32]

Values = npt.NDArray[np.float32]

Item = TypeVar("Item", np.int32, np.float32)


class UniformRow(IntEnum):
    """Rows, and tables, of leaves that have one sign and no values; all further ones have values."""

    OUTSIDE = 0
    INSIDE = 1


class GrowingArray(Generic[Item]):
    """An array to which rows are appended; it grows by half, so that a row costs the same however many there are."""

    def __init__(self, first: npt.NDArray[Item]) -> None:
        self._room: npt.NDArray[Item] = first.copy()
        self._count = len(first)

    @property
    def rows(self) -> npt.NDArray[Item]:
        """All rows so far; an array taken before `append` may be out of date after it."""
        rows: npt.NDArray[Item] = self._room[: self._count]
        return rows

    def append(self, rows: npt.NDArray[Item]) -> Rows:
        """Add rows and return their numbers, of shape (N,)."""
        start, self._count = self._count, self._count + len(rows)
        if self._count > len(self._room):
            # In place, so that the old and the new array are not held together.
            self._room.resize((self._count + self._count // 2, *self._room.shape[1:]), refcheck=False)
        self._room[start : self._count] = rows
        return np.arange(start, self._count, dtype=np.int32)


class LeafStore:
    """Values at the nodes of a lattice where they are known, and signs elsewhere.

    Parameters
    ----------
    chunks : integer array of shape (3,)
        Number of chunks along each axis; beyond them everything is outside.
    limit : float
        Magnitude that stands for unknown values.
    leaf_cells, chunk_cells : int
        Cells along a leaf, and along a chunk, see `ExtractionParameters`.
    """

    def __init__(
        self,
        chunks: Int,
        limit: float,
        *,
        leaf_cells: int = ExportParameters.extraction.leaf_cells,
        chunk_cells: int = ExportParameters.extraction.chunk_cells,
    ) -> None:
        self.leaf_cells, self.chunk_cells = leaf_cells, chunk_cells
        self.chunk_leaves = chunk_cells // leaf_cells
        # One chunk more along each axis, always outside, so that upper neighbours exist.
        self._index: Rows = np.full(chunks + 1, UniformRow.OUTSIDE, dtype=np.int32)
        uniform = np.array(list(UniformRow), dtype=np.int32)[:, None, None, None]
        self._tables = GrowingArray(np.broadcast_to(uniform, (len(uniform), *3 * [self.chunk_leaves])))
        signs = np.array([limit, -limit], dtype=np.float32)[:, None, None, None]
        self._store = GrowingArray(np.broadcast_to(signs, (len(signs), *3 * [leaf_cells])))

    def __len__(self) -> int:
        """How many leaves have values."""
        return len(self._store.rows) - len(UniformRow)

    @staticmethod
    def has_values(rows: Rows) -> Mask:
        """Which rows, or tables, are not uniform; of their shape."""
        return np.asarray(rows >= len(UniformRow))

    def mark_inside(self, blocks: Int, size: int) -> None:
        """Mark the given blocks, of shape (N, 3) and of `size` cells a side, as wholly inside."""
        if not len(blocks):
            return
        if size >= self.chunk_cells:
            chunks = size // self.chunk_cells
            for offset in itertools.product(range(chunks), repeat=3):
                self._index[tuple((blocks * chunks + offset).T)] = UniformRow.INSIDE
            return
        leaves = size // self.leaf_cells
        for offset in itertools.product(range(leaves), repeat=3):
            self._set_rows(blocks * leaves + offset, np.full(len(blocks), UniformRow.INSIDE, dtype=np.int32))

    def store(self, leaves: Int, values: Values) -> None:
        """Store the values, of shape (N, 4, 4, 4), at the lower corners of the cells of leaves of shape (N, 3)."""
        self._set_rows(leaves, self._store.append(values))

    def _set_rows(self, leaves: Int, rows: Rows) -> None:
        chunks, local = np.divmod(leaves, self.chunk_leaves)
        # Chunks with a uniform table get a copy of it before a leaf in them changes.
        uniform = np.unique(chunks[~self.has_values(self._index[tuple(chunks.T)])], axis=0)
        if len(uniform):
            where = tuple(uniform.T)
            self._index[where] = self._tables.append(self._tables.rows[self._index[where]])
        self._tables.rows[(self._index[tuple(chunks.T)], *local.T)] = rows

    def rows(self, chunk: Int) -> Rows:
        """Rows of a chunk's leaves and of their upper neighbours, of shape (9, 9, 9)."""
        # The upper neighbours' lowest leaves hold the nodes on the chunk's upper faces.
        i, j, k = chunk
        side = self.chunk_leaves
        tables = self._tables.rows[self._index[i : i + 2, j : j + 2, k : k + 2]]
        joined = tables.transpose(0, 3, 1, 4, 2, 5).reshape(2 * side, 2 * side, 2 * side)
        return joined[: side + 1, : side + 1, : side + 1]

    def nodes(self, rows: Rows) -> Values:
        """Values at a chunk's nodes, of shape (33, 33, 33), from its `rows`."""
        length = (self.chunk_leaves + 1) * self.leaf_cells
        values = self._store.rows[rows].transpose(0, 3, 1, 4, 2, 5).reshape(length, length, length)
        return values[: self.chunk_cells + 1, : self.chunk_cells + 1, : self.chunk_cells + 1]

    def mixed_chunks(self) -> Int:
        """Chunks, of shape (C, 3), whose nodes may differ in sign, ordered along the axes."""
        # A uniform chunk matters too where a neighbour differs: the cells between them have both signs.
        low = self._index[:-1, :-1, :-1]
        mixed = self.has_values(low)
        for i, j, k in itertools.product((0, 1), repeat=3):
            ends = (slice(o, o + n) for o, n in zip((i, j, k), low.shape, strict=True))
            mixed |= self._index[tuple(ends)] != low
        return np.argwhere(mixed).astype(np.int64)
