"""Marching cubes over a narrow band, stitched exactly.

Lewiner's marching cubes (scikit-image) runs on chunks of 32 cells. It puts a vertex on each lattice edge whose ends
differ in sign, and in some ambiguous cells one more within the cell. A vertex is therefore named by an integer: the
lower node of its edge and the edge's axis (or the cell and axis 3). Chunks that share a face name the vertices on it
alike, so that equal names, and never a tolerance, sew the mesh together. Positions are interpolated afresh in float64
from the values at the edge's two ends.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from gnrecon.export.lattice import Lattice
from gnrecon.export.project import SignedDistance
from gnrecon.export.sparse_grid import Band, narrow_band
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError
from gnrecon.runtime.progress import Advance, part, unheard

EVALUATED = 0.9
"""About which share of the time has passed when the field is known; marching cubes takes the rest."""


def extract(
    field: SignedDistance,
    *,
    resolution: int = 256,
    bounds: Float | None = None,
    data: Float | None = None,
    batch: int = 65536,
    advance: Advance = unheard,
) -> Mesh:
    """Mesh the zero level of a field.

    Parameters
    ----------
    field : SignedDistance
    resolution : int
        Cells along the longest side of the box; cells are cubes.
    bounds : array of shape (2, 3), file units, optional
        The box; by default the field's own. A shape that reaches beyond it is closed by a flat cap.
    data : array of shape (N, 3), file units, optional
        What the field was fitted to. Sheets that no data is near, and that do not hang together with one that is, may
        then be left out, which saves most of the work where the field is steep in free space.
    batch : int
        Most points to ask the field for at once.
    advance : callable
        Told of the share that is done after each batch, and after each chunk that the surface passes.

    Returns
    -------
    Mesh
        Closed and oriented outward, in file units, without normals. Vertices are accurate to second order in the
        cell's size; `project` brings them onto the zero level.

    Raises
    ------
    MeshError
        When the field has no zero level in the box, or is not finite.
    UsageError
        When the resolution, the bounds or the batch make no sense.
    """
    lattice = Lattice.over(field, resolution, bounds, batch)
    band = narrow_band(lattice, None if data is None else lattice.nodes(data), part(advance, 0.0, EVALUATED))
    pieces = _march_all(band, part(advance, EVALUATED, 1.0))
    del band
    if not pieces:
        raise MeshError(
            f"The field has no zero level among the {' x '.join(str(n + 1) for n in lattice.cells)} points of its box, "
            f"so there is no surface to mesh."
        )
    return _stitched(lattice, pieces)


@dataclass(frozen=True)
class Piece:
    """The surface within one chunk.

    Parameters
    ----------
    names : integer array of shape (V,)
        Of the vertices: the same in every chunk that has them.
    places : array of shape (V, 3), lattice coordinates
    faces : integer array of shape (F, 3)
        Rows of the above.
    """

    names: Int
    places: Float
    faces: npt.NDArray[np.int32]


def _march_all(band: Band, advance: Advance) -> list[Piece]:
    pieces = []
    chunks = band.leaves.mixed_chunks()
    for number, chunk in enumerate(chunks, 1):
        piece = _march(band, chunk)
        if piece is not None:
            pieces.append(piece)
            advance(number / len(chunks))
    advance(1.0)
    return pieces


def _march(band: Band, chunk: Int) -> Piece | None:
    """Run marching cubes on one chunk; None where nothing crosses."""
    from skimage import measure

    values = band.leaves.nodes(band.leaves.rows(chunk))
    if not (values.min() < 0 < values.max()):
        return None
    marching_cubes: Any = measure.marching_cubes
    rough, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent", method="lewiner")
    on_axis = rough != np.round(rough)
    # Rounding along the edge's own axis must go down, across it to the node that the coordinate already is.
    nodes = np.floor(rough).astype(np.int64)
    axis = np.where(on_axis.sum(axis=1) == 1, on_axis.argmax(axis=1), 3)
    places = rough.astype(np.float64)
    edges = np.flatnonzero(axis < 3)
    places[edges, axis[edges]] = nodes[edges, axis[edges]] + _crossings(values, nodes[edges], axis[edges])
    nodes += chunk * CHUNK
    sides = band.lattice.cells + 1
    names = ((nodes[:, 0] * sides[1] + nodes[:, 1]) * sides[2] + nodes[:, 2]) * 4 + axis
    return Piece(names, places + chunk * CHUNK, faces.astype(np.int32))


def _crossings(values: Values, nodes: Int, axis: Int) -> Float:
    """Where along its edge, from 0 to 1, the linear interpolant vanishes."""
    low = values[tuple(nodes.T)].astype(np.float64)
    high = values[tuple((nodes + np.eye(3, dtype=np.int64)[axis]).T)]
    crossings: Float = low / (low - high)
    return crossings


def _stitched(lattice: Lattice, pieces: list[Piece]) -> Mesh:
    """Join the pieces by the names of their vertices; the list is emptied, because both would take twice the memory."""
    _, first, inverse = np.unique(
        np.concatenate([piece.names for piece in pieces]), return_index=True, return_inverse=True
    )
    vertices = np.empty((len(first), 3))
    faces = np.empty((sum(len(piece.faces) for piece in pieces), 3), dtype=np.int64)
    done = start = 0
    while pieces:
        piece = pieces.pop(0)
        rows = slice(start, start + len(piece.names))
        vertices[inverse[rows]] = lattice.world(piece.places)
        faces[done : done + len(piece.faces)] = inverse[rows][piece.faces]
        done, start = done + len(piece.faces), rows.stop
    return Mesh(vertices, faces)


LEAF, CHUNK = 4, 32
"""Cells along a leaf, and along a chunk (what marching cubes sees at once)."""

SIDE = CHUNK // LEAF

OUTSIDE, INSIDE, FIRST = 0, 1, 2

Rows = npt.NDArray[np.int32]

Values = npt.NDArray[np.float32]

Item = TypeVar("Item", np.int32, np.float32)


# Node values of the leaves that were evaluated, and the signs of all others, in memory that grows with the surface.
#
# Leaves are blocks of 4 cells a side, chunks are blocks of 8 leaves a side. An index names the table of each chunk, and
# a table the row of each of its leaves in a store of values. Table and row 0 stand for what is wholly outside, 1 for
# what is wholly inside; a chunk has a table of its own only where its leaves differ.


class Growing(Generic[Item]):
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


class Leaves:
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
        self._tables = Growing(np.broadcast_to(uniform, (FIRST, SIDE, SIDE, SIDE)))
        signs = np.array([limit, -limit], dtype=np.float32)[:, None, None, None]
        self._store = Growing(np.broadcast_to(signs, (FIRST, LEAF, LEAF, LEAF)))

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

    def keep(self, leaves: Int, values: Values) -> None:
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
