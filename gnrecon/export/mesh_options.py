"""How finely a field is meshed, and what is done to the mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from gnrecon.export.remeshing.refine import RefineOptions
from gnrecon.export.resolution import LEAST_CELLS, cells_for_edges
from gnrecon.geometry.arrays import Float
from gnrecon.runtime.errors import UsageError


@dataclass(frozen=True)
class MeshOptions:
    """Options of `mesh_field`.

    Parameters
    ----------
    resolution : int, optional
        Cells along the longest side of the box; by default `default_cells`.
    edge_length : float, file units, optional
        Mean length of the mesh's edges, from which the number of cells follows.
    max_error : float, file units, optional
        Distance from the field's surface that 99.9 % of face centres and edge midpoints stay within; the mesh is made
        finer until they do, up to 1,024 cells.
    keep_handles : bool
        Whether handles and tunnels that no points support stay, see `gnrecon.export.remove_handles`.
    refine : RefineOptions
        Remeshing and decimation.
    default_cells : int
        Cells where neither a resolution nor an edge length is given.

    Raises
    ------
    UsageError
        When a value is out of its range.
    """

    resolution: int | None = None
    edge_length: float | None = None
    max_error: float | None = None
    keep_handles: bool = False
    refine: RefineOptions = field(default_factory=RefineOptions)
    default_cells: int = 256

    def __post_init__(self) -> None:
        if self.resolution is not None and self.edge_length is not None:
            raise UsageError("An edge length decides the resolution, so that only one of the two can be given.")
        if self.resolution is not None and self.resolution < LEAST_CELLS:
            raise UsageError(f"The resolution must be at least {LEAST_CELLS} cells, not {self.resolution}.")
        for name, value in (("edge length", self.edge_length), ("greatest error", self.max_error)):
            if value is not None and not 0 < value < math.inf:
                raise UsageError(f"The {name} must be a positive length, not {value:g}.")

    def cells(self, bounds: Float) -> int:
        """Return the cells along the longest side of a box, of shape (2, 3) in file units, to begin with.

        Raises
        ------
        UsageError
            When the edge length would need too few or too many.
        """
        if self.edge_length is not None:
            return cells_for_edges(self.edge_length, bounds)
        return self.resolution or self.default_cells
