"""The narrow band: only the lattice nodes near the zero level are evaluated.

`search` names the leaves through which the zero level may pass; those are evaluated node by node, all others have but a
sign. What the search misses is found by propagation: as long as a cell with a sign change has a corner that was not
evaluated, the leaves of its corners are. Every node thus has exactly one sign, evaluated or not, and marching cubes
over all of them cannot leave a hole. Memory grows with the surface: about 6 nodes for each vertex.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from gnrecon.export.lattice import Lattice
from gnrecon.export.leaves import CHUNK, FIRST, INSIDE, LEAF, OUTSIDE, SIDE, Leaves, Values
from gnrecon.export.search import Coarse, search
from gnrecon.geometry.arrays import Float, Int
from gnrecon.runtime.parallel import slices
from gnrecon.runtime.progress import Advance, part, unheard

NUDGE = 1e-4
"""Least magnitude of a node's value, in cells over the slope: no vertex falls on a node and makes faces degenerate."""

LIMIT = 8.0
"""Greatest magnitude, likewise; together they keep crossings clear of nodes in scikit-image's float32."""

_NODES = np.stack(np.meshgrid(*3 * [np.arange(LEAF)], indexing="ij"), axis=-1).reshape(-1, 3)
_CORNERS = tuple(itertools.product((0, 1), repeat=3))

LOCATED = 0.1
"""About which share of the time has passed when the leaves to evaluate are known."""


@dataclass(frozen=True)
class Band:
    """Node values around the zero level, in cells divided by the typical slope.

    Parameters
    ----------
    lattice : Lattice
    slope : float
        Slope by which values are divided.
    leaves : Leaves
    """

    lattice: Lattice
    slope: float
    leaves: Leaves

    def values(self, leaves: Int) -> Values:
        """The field at the nodes of leaves, of shape (N, 3): clear, of shape (N, K)."""
        return self.clear(self.lattice.values_of_blocks(leaves * LEAF, _NODES, self.slope))

    def clear(self, values: Float) -> Values:
        """Return values over the slope, of any shape, clear of zero and of bounded magnitude."""
        clear = np.where(np.abs(values) < NUDGE, np.where(values < 0, -NUDGE, NUDGE), values)
        return np.clip(clear, -LIMIT, LIMIT).astype(np.float32)

    def evaluate(self, leaves: Int, advance: Advance = unheard) -> None:
        """Ask the field for all nodes of the given leaves, of shape (N, 3), and keep them."""
        for rows in slices(len(leaves), self.lattice.together(len(_NODES))):
            advance(rows.start / len(leaves))
            some = leaves[rows]
            self.leaves.keep(some, self.values(some).reshape(-1, LEAF, LEAF, LEAF))

    def missing(self, chunk: Int) -> Int:
        """Leaves, of shape (N, 3), that hold an unevaluated corner of a cell with a sign change in this chunk."""
        rows = self.leaves.rows(chunk)
        if (rows >= FIRST).all() or (rows == OUTSIDE).all() or (rows == INSIDE).all():
            return np.empty((0, 3), dtype=np.int64)
        negative = self.leaves.nodes(rows) < 0
        unknown = (rows < FIRST).repeat(LEAF, 0).repeat(LEAF, 1).repeat(LEAF, 2)
        unknown = unknown[: CHUNK + 1, : CHUNK + 1, : CHUNK + 1]
        corners = [tuple(slice(o, o + CHUNK) for o in corner) for corner in _CORNERS]
        crossed = np.logical_or.reduce([negative[c] for c in corners])
        crossed &= ~np.logical_and.reduce([negative[c] for c in corners])
        wanted = np.zeros_like(negative)
        for corner in corners:
            wanted[corner] |= crossed & unknown[corner]
        return np.unique(np.argwhere(wanted) // LEAF, axis=0) + chunk * SIDE


def narrow_band(lattice: Lattice, data: Float | None = None, advance: Advance = unheard) -> Band:
    """Evaluate the field where its zero level may pass.

    Parameters
    ----------
    lattice : Lattice
    data : array of shape (N, 3), lattice coordinates, optional
        Points near which the surface is searched; everywhere when None.
    advance : callable
        Told of the share that is done after each batch of points.

    Raises
    ------
    MeshError
        When the field is not finite somewhere.
    """
    coarse = Coarse.of(lattice)
    advance(LOCATED)
    # A field that is constant at all samples has no slope there; any positive number keeps the division defined.
    band = Band(lattice, max(coarse.typical, 1e-6), Leaves(-(-(lattice.cells + 1) // CHUNK), LIMIT))
    done = LOCATED
    for share, leaves in search(lattice, coarse, band.leaves, data):
        begin, done = done, LOCATED + (1.0 - LOCATED) * share
        band.evaluate(leaves, part(advance, begin, done))
    _propagate(band)
    return band


def _propagate(band: Band) -> None:
    """Evaluate further leaves until every corner of every cell with a sign change has its own value."""
    queue = band.leaves.mixed_chunks()
    while len(queue):
        found = [band.missing(chunk) for chunk in queue]
        leaves = np.unique(np.concatenate(found), axis=0)
        if not len(leaves):
            return
        band.evaluate(leaves)
        # A new value also changes cells of the lower neighbours, whose upper corners it is.
        touched = ((leaves[:, None] - np.array(_CORNERS)) // SIDE).reshape(-1, 3)
        queue = np.unique(touched[(touched >= 0).all(axis=1)], axis=0)
