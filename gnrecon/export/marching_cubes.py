"""Marching cubes over a narrow band, stitched exactly.

Lewiner's marching cubes (scikit-image) runs on chunks of 32 cells. It puts a vertex on each lattice edge whose ends
differ in sign, and in some ambiguous cells one more within the cell. A vertex is therefore named by an integer: the
lower node of its edge and the edge's axis (or the cell and axis 3). Chunks that share a face give the vertices on it
the same names, so that the mesh is joined by equal names and never by a tolerance. Positions are interpolated again in
float64 from the values at the edge's two ends. The entry is `extract`.

Source: Lewiner, Lopes, Vieira and Tavares, Efficient implementation of marching cubes' cases with topological
guarantees, Journal of Graphics Tools 8 (2003).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.export.export_parameters import ExtractionParameters
from gnrecon.export.lattice import Lattice
from gnrecon.export.leaf_storage import Values
from gnrecon.export.project import SignedDistance
from gnrecon.export.sparse_grid import NarrowBand, narrow_band
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange


def extract(
    field: SignedDistance,
    *,
    resolution: int = 256,
    bounds: Float | None = None,
    data: Float | None = None,
    batch: int = 65536,
    advance: ProgressCallback = ignore_progress,
    parameters: ExtractionParameters | None = None,
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
        What the field was fitted to. Sheets without data nearby that are not connected to one with data may then be
        left out, which saves most of the work where the field is steep in free space.
    batch : int
        Most points to evaluate at once.
    advance : callable
        Receives the share that is done, after each batch and after each chunk that the surface passes.
    parameters : ExtractionParameters, optional
        By default ``ExtractionParameters()``.

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
        When the resolution, the bounds or the batch are out of range.
    """
    lattice = Lattice.over(field, resolution, bounds, batch)
    # Evaluating the field takes about nine tenths of the time.
    band = narrow_band(
        lattice,
        None if data is None else lattice.nodes(data),
        subrange(advance, 0.0, 0.9),
        parameters=parameters or ExtractionParameters(),
    )
    pieces = _march_all(band, subrange(advance, 0.9, 1.0))
    del band
    if not pieces:
        raise MeshError(
            f"The field has no zero level among the {' x '.join(str(n + 1) for n in lattice.cells)} points of its box, "
            f"so there is no surface to mesh."
        )
    return _stitch(lattice, pieces)


@dataclass(frozen=True)
class ChunkMesh:
    """The surface within one chunk.

    Parameters
    ----------
    names : integer array of shape (V,)
        Of the vertices: the same in every chunk that has them.
    positions : array of shape (V, 3), lattice coordinates
    faces : integer array of shape (F, 3)
        Rows of the above.
    """

    names: Int
    positions: Float
    faces: npt.NDArray[np.int32]


def _march_all(band: NarrowBand, advance: ProgressCallback) -> list[ChunkMesh]:
    pieces = []
    chunks = band.leaves.mixed_chunks()
    for number, chunk in enumerate(chunks, 1):
        piece = _march(band, chunk)
        if piece is not None:
            pieces.append(piece)
            advance(number / len(chunks))
    advance(1.0)
    return pieces


def _march(band: NarrowBand, chunk: Int) -> ChunkMesh | None:
    """Run marching cubes on one chunk; None where nothing crosses."""
    from skimage import measure

    values = band.leaves.nodes(band.leaves.rows(chunk))
    # Values are never zero, see `NarrowBand.clamp`, so that a chunk of one sign has no surface.
    if not (values.min() < 0 < values.max()):
        return None
    marching_cubes: Any = measure.marching_cubes
    rough, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent", method="lewiner")
    # A vertex on a lattice edge has one coordinate that is not a whole number; one within a cell has more.
    on_axis = rough != np.round(rough)
    # Rounding along the edge's own axis must go down, across it to the node that the coordinate already is.
    nodes = np.floor(rough).astype(np.int64)
    axis = np.where(on_axis.sum(axis=1) == 1, on_axis.argmax(axis=1), 3)
    positions = rough.astype(np.float64)
    edges = np.flatnonzero(axis < 3)
    positions[edges, axis[edges]] = nodes[edges, axis[edges]] + _crossings(values, nodes[edges], axis[edges])
    origin = chunk * band.parameters.chunk_cells
    nodes += origin
    # Mixed radix: three node coordinates and one of four axes in one integer.
    sides = band.lattice.cells + 1
    names = ((nodes[:, 0] * sides[1] + nodes[:, 1]) * sides[2] + nodes[:, 2]) * 4 + axis
    return ChunkMesh(names, positions + origin, faces.astype(np.int32))


def _crossings(values: Values, nodes: Int, axis: Int) -> Float:
    """Where along its edge, from 0 to 1, the linear interpolant vanishes."""
    low = values[tuple(nodes.T)].astype(np.float64)
    high = values[tuple((nodes + np.eye(3, dtype=np.int64)[axis]).T)]
    crossings: Float = low / (low - high)
    return crossings


def _stitch(lattice: Lattice, pieces: list[ChunkMesh]) -> Mesh:
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
        vertices[inverse[rows]] = lattice.world(piece.positions)
        faces[done : done + len(piece.faces)] = inverse[rows][piece.faces]
        done, start = done + len(piece.faces), rows.stop
    return Mesh(vertices, faces)
