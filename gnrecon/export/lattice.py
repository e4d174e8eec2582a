"""The regular lattice on which a field is sampled, closed at the border of its box.

Nodes are integer triples. The lattice is in unit coordinates, where the shape has radius one, so that a distant
origin (projected coordinates in metres) costs no digits; only the field itself takes file coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gnrecon.export.project import SignedDistance, evaluates_blocks, sdf_around
from gnrecon.geometry.arrays import Float, Int
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress


@dataclass(frozen=True)
class Lattice:
    """Cubic cells over a box.

    Parameters
    ----------
    field : SignedDistance
        The field to sample.
    origin : array of shape (3,), unit coordinates
        Position of node (0, 0, 0).
    cell : float, unit coordinates
        Edge length of a cell.
    cells : integer array of shape (3,)
        Number of cells along each axis; there is one node more.
    batch : int
        Most points to evaluate at once.
    """

    field: SignedDistance
    origin: Float
    cell: float
    cells: Int
    batch: int

    @classmethod
    def over(cls, field: SignedDistance, resolution: int, bounds: Float | None, batch: int) -> Lattice:
        """Return the lattice of `resolution` cells along the longest side of `bounds`, centred on them.

        Raises
        ------
        UsageError
            When the resolution is below 4, the batch below 1, or the bounds are no box.
        """
        if resolution < 4:
            raise UsageError(f"The resolution is {resolution}, but must be at least 4 cells.")
        if batch < 1:
            raise UsageError(f"The batch is {batch} points, but must be at least 1.")
        box = np.asarray(field.bounds if bounds is None else bounds, dtype=np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
            raise UsageError(f"The bounds {box.tolist()} are not a lower and an upper corner of a box.")
        low, high = field.frame.to_unit(box)
        cell = float((high - low).max() / resolution)
        # The small allowance keeps a side that is a whole number of cells from gaining one by rounding.
        cells = np.maximum(np.ceil((high - low) / cell - 1e-9), 1).astype(np.int64)
        return cls(field, (low + high - cell * cells) / 2, cell, cells, batch)

    def world(self, nodes: npt.NDArray[np.floating] | Int) -> Float:
        """File coordinates of lattice coordinates, both of shape (N, 3)."""
        return self.field.frame.to_world(self.origin + self.cell * nodes)

    def nodes(self, points: Float) -> Float:
        """Lattice coordinates of file coordinates, both of shape (N, 3)."""
        coordinates: Float = (self.field.frame.to_unit(points) - self.origin) / self.cell
        return coordinates

    def values(
        self, nodes: npt.NDArray[np.floating] | Int, slope: float, advance: ProgressCallback = ignore_progress
    ) -> Float:
        """Field in cells over its slope, of shape (N,), at lattice coordinates of shape (N, 3), closed at the box.

        Closing is the intersection with the box that ends half a cell before the outermost layer, so that this layer
        is always outside and a shape that reaches further ends in a flat cap.

        Raises
        ------
        MeshError
            When the field is not finite somewhere.
        """
        return self._closed_at_box(self._evaluate(np.clip(nodes, 0, self.cells), advance), nodes, slope)

    def blocks_per_batch(self, nodes: int, *, points_per_block: int = 8) -> int:
        """Return how many blocks of so many nodes the field is evaluated in at once.

        A field that evaluates whole blocks shares work between them, so that a block counts as `points_per_block`.
        """
        return max(1, self.batch // (points_per_block if evaluates_blocks(self.field) else nodes))

    def values_of_blocks(self, corners: Int, offsets: Int, slope: float) -> Float:
        """Return what `values` does, of shape (N, K), at K offsets from N corners, at most `blocks_per_batch` of them.

        Parameters
        ----------
        corners : array of shape (N, 3)
            The lower corners.
        offsets : array of shape (K, 3)
            Of the nodes of every block, not negative.
        slope : float

        Raises
        ------
        MeshError
            When the field is not finite somewhere.
        """
        nodes = corners[:, None] + offsets
        out = np.empty(nodes.shape[:2])
        # The field is not evaluated beyond its box.
        within = (nodes <= self.cells).all(axis=(1, 2))
        relative = self.cell * self.field.frame.scale * offsets.astype(np.float64)
        out[within] = sdf_around(self.field, self.world(corners[within]), relative)
        if not within.all():
            clipped = np.minimum(nodes[~within], self.cells).reshape(-1, 3)
            out[~within] = self._evaluate(clipped).reshape(-1, len(offsets))
        return self._closed_at_box(out, nodes, slope)

    def _evaluate(self, nodes: npt.NDArray[np.floating] | Int, advance: ProgressCallback = ignore_progress) -> Float:
        """Return the field in file units, of shape (N,), at lattice coordinates of shape (N, 3)."""
        out = np.empty(len(nodes))
        for rows in slices(len(nodes), self.batch):
            out[rows] = self.field.sdf(self.world(nodes[rows]))
            advance(rows.stop / len(nodes))
        return out

    def _closed_at_box(self, values: Float, nodes: npt.NDArray[np.floating] | Int, slope: float) -> Float:
        """Return the field in cells over its slope, closed at the box, by its values in file units."""
        if not np.isfinite(values).all():
            count = np.count_nonzero(~np.isfinite(values))
            raise MeshError(f"The field is not finite at {count} of {values.size} points.")
        # Cells to the nearest side of the box; negative beyond it.
        depth = np.minimum(nodes, self.cells - nodes).min(axis=-1)
        closed: Float = np.maximum(values / (self.field.frame.scale * self.cell * slope), 0.5 - depth)
        return closed

    def gradients(self, nodes: npt.NDArray[np.floating] | Int) -> Float:
        """Gradient of the field, of shape (N, 3), at lattice coordinates of shape (N, 3)."""
        # Centres of border blocks may be beyond the box, where the field is not evaluated.
        inside = np.clip(nodes, 0, self.cells)
        out = np.empty((len(nodes), 3))
        for rows in slices(len(nodes), self.batch):
            out[rows] = self.field.gradient(self.world(inside[rows]))
        return out
