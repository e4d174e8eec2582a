"""Node values of the leaves that were evaluated, and the signs of all others, in memory that grows with the surface.

Leaves are blocks of 4 cells a side, chunks are blocks of 8 leaves a side. An index names the table of each chunk, and a
table the row of each of its leaves in a store of values. Table and row 0 stand for what is wholly outside, 1 for what
is wholly inside; a chunk has a table of its own only where its leaves differ.
"""

from __future__ import annotations

import itertools
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Int

LEAF, CHUNK = 4, 32
"""Cells along a leaf, and along a chunk (what marching cubes sees at once)."""

SIDE = CHUNK // LEAF

OUTSIDE, INSIDE, FIRST = 0, 1, 2

Rows = npt.NDArray[np.int32]

Values = npt.NDArray[np.float32]

Item = TypeVar("Item", np.int32, np.float32)


class GrowingArray(Generic[Item]):
    """An array to which rows are appended; it grows by half, so that a row costs the same however many there are."""

    def __init__(self, first: npt.NDArray[Item]) -> None:
        self._room: npt.NDArray[Item] = first.copy()
        self._count = len(first)

    @property
    def rows(self) -> npt.NDArray[Item]:
        """All rows so far; to be asked for again after each `append`."""
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
    """Values at the nodes of a lattice, where they are known, else a sign.

    Parameters
    ----------
    chunks : integer array of shape (3,)
        Number of chunks along each axis; beyond them everything is outside.
    limit : float
        Magnitude that stands for the values that are not known.
    """

    def __init__(self, chunks: Int, limit: float) -> None:
        self._index: Rows = np.full(chunks + 1, OUTSIDE, dtype=np.int32)
        uniform = np.array([OUTSIDE, INSIDE], dtype=np.int32)[:, None, None, None]
        self._tables = GrowingArray(np.broadcast_to(uniform, (FIRST, SIDE, SIDE, SIDE)))
        signs = np.array([limit, -limit], dtype=np.float32)[:, None, None, None]
        self._store = GrowingArray(np.broadcast_to(signs, (FIRST, LEAF, LEAF, LEAF)))

    def __len__(self) -> int:
        """How many leaves have values."""
        return len(self._store.rows) - FIRST

    def mark_inside(self, blocks: Int, size: int) -> None:
        """Mark the given blocks, of shape (N, 3) and of `size` cells a side, as wholly inside."""
        if not len(blocks):
            return
        if size >= CHUNK:
            for offset in itertools.product(range(size // CHUNK), repeat=3):
                self._index[tuple((blocks * (size // CHUNK) + offset).T)] = INSIDE
            return
        for offset in itertools.product(range(size // LEAF), repeat=3):
            self._point(blocks * (size // LEAF) + offset, np.full(len(blocks), INSIDE, dtype=np.int32))

    def store(self, leaves: Int, values: Values) -> None:
        """Keep the values, of shape (N, 4, 4, 4), at the lower corners of the cells of leaves of shape (N, 3)."""
        self._point(leaves, self._store.append(values))

    def _point(self, leaves: Int, rows: Rows) -> None:
        chunks, local = np.divmod(leaves, SIDE)
        bare = np.unique(chunks[self._index[tuple(chunks.T)] < FIRST], axis=0)
        if len(bare):
            where = tuple(bare.T)
            self._index[where] = self._tables.append(self._tables.rows[self._index[where]])
        self._tables.rows[(self._index[tuple(chunks.T)], *local.T)] = rows

    def rows(self, chunk: Int) -> Rows:
        """Rows of a chunk's leaves and of their upper neighbours, of shape (9, 9, 9); below FIRST without values."""
        i, j, k = chunk
        tables = self._tables.rows[self._index[i : i + 2, j : j + 2, k : k + 2]]
        joined = tables.transpose(0, 3, 1, 4, 2, 5).reshape(2 * SIDE, 2 * SIDE, 2 * SIDE)
        return joined[: SIDE + 1, : SIDE + 1, : SIDE + 1]

    def nodes(self, rows: Rows) -> Values:
        """Values at a chunk's nodes, of shape (33, 33, 33), from its `rows`."""
        length = (SIDE + 1) * LEAF
        values = self._store.rows[rows].transpose(0, 3, 1, 4, 2, 5).reshape(length, length, length)
        return values[: CHUNK + 1, : CHUNK + 1, : CHUNK + 1]

    def mixed_chunks(self) -> Int:
        """Chunks, of shape (C, 3), whose nodes may differ in sign, ordered along the axes."""
        low = self._index[:-1, :-1, :-1]
        mixed = low >= FIRST
        for i, j, k in itertools.product((0, 1), repeat=3):
            ends = (slice(o, o + n) for o, n in zip((i, j, k), low.shape, strict=True))
            mixed |= self._index[tuple(ends)] != low
        return np.argwhere(mixed).astype(np.int64)
