"""Parameters of the search for level sets and of the projection onto them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LevelSetParameters:
    """Shared by the functions that find, sample and project onto level sets."""

    # Points per batch, so that the layers of a small network fit into the processor's cache.
    batch_points: int = 8192
    # Evaluations of f with which a level set is searched for; cells of the grid have the size (volume / nodes)^(1/3).
    grid_nodes: int = 100_000
    # Side of the blocks that are skipped if f cannot be zero in them, in cells of the grid.
    block_cells: int = 3
    # Distance from the level set at which a point counts as on it, in diagonals of the box, unless rounding forbids.
    tolerance_diagonals: float = 1e-14
    # The same where only rounding errors are left, in units of the tolerance above.
    rounding_tolerances: float = 20.0
    # Newton steps after which a point within the rounding tolerance is not moved again; convergence is quadratic.
    quadratic_steps: int = 5
    # Cells along the longest side of the grid on which components are found, as in the paper.
    component_cells: int = 64
