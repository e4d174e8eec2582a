"""The narrow band: only the lattice nodes near the zero level are evaluated.

A function with Lipschitz constant L has no zero in a block of half diagonal d around c when |f(c)| > L d. Blocks of 16
cells a side that may hold a zero are split into blocks of 8 and then 4 cells; those of 4 that remain are evaluated node
by node, all others keep nothing but the sign of their centre. L is measured from gradients, so it may be too small
somewhere. What is missed is found by propagation: as long as a cell with a sign change has a corner that was not
evaluated, the blocks of its corners are. Every node thus has exactly one sign, evaluated or not, and marching cubes
over all of them cannot leave a hole. Memory grows with the surface: about 8 nodes for each cell that it crosses.

Where the data is known, only blocks near it are searched, and what lies farther off is found by propagation, which
follows the surface from there: sheets in free space, where a field is steep and L large, cost next to nothing then.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.advance import Advance, part, unheard
from gnrecon.cloud import Float
from gnrecon.export.lattice import Int, Lattice

COARSE, LEAF, CHUNK = 16, 4, 32
"""Cells along a coarse block, a leaf (the blocks that are evaluated) and a chunk (what marching cubes sees at once)."""

NUDGE = 1e-4
"""Least magnitude of a node's value, in cells over the slope: no vertex falls on a node and makes faces degenerate."""

LIMIT = 8.0
"""Greatest magnitude, likewise; together they keep crossings clear of nodes in scikit-image's float32."""

REACH = 2.0
"""How far beyond a data point the surface is searched, in cells."""

OUTSIDE, INSIDE, FIRST = 0, 1, 2
"""Rows of the store: leaves known only to be outside or inside, and the first leaf with values of its own."""

_LEAVES = CHUNK // LEAF
_LEAF_NODES = np.stack(np.meshgrid(*3 * [np.arange(LEAF)], indexing="ij"), axis=-1).reshape(-1, 3)
_CORNERS = tuple(itertools.product((0, 1), repeat=3))

LOCATED = 0.1
"""About which share of the time has passed when the leaves to evaluate are known."""


@dataclass
class Band:
    """Node values around the zero level, in cells divided by the Lipschitz constant.

    Parameters
    ----------
    lattice : Lattice
    slope : float
        Lipschitz constant by which values are divided.
    rows : integer array, one entry a leaf
        Row of the store; padded to whole chunks and by one leaf of `OUTSIDE` at the upper ends.
    store : array of shape (rows, 4, 4, 4)
        Values of the nodes that a leaf owns: those of its cells' lower corners.
    """

    lattice: Lattice
    slope: float
    rows: npt.NDArray[np.int32]
    store: Float

    def chunks(self) -> Int:
        """All chunks, of shape (C, 3)."""
        counts = (np.array(self.rows.shape) - 1) // _LEAVES
        return np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)

    def leaves(self, chunk: Int) -> npt.NDArray[np.int32]:
        """Rows of a chunk's leaves and of their upper neighbours, of shape (9, 9, 9)."""
        i, j, k = chunk * _LEAVES
        return self.rows[i : i + _LEAVES + 1, j : j + _LEAVES + 1, k : k + _LEAVES + 1]

    def nodes(self, chunk: Int) -> Float:
        """Values at a chunk's nodes, of shape (33, 33, 33)."""
        side = (_LEAVES + 1) * LEAF
        values = self.store[self.leaves(chunk)].transpose(0, 3, 1, 4, 2, 5).reshape(side, side, side)
        return values[: CHUNK + 1, : CHUNK + 1, : CHUNK + 1]

    def evaluate(self, leaves: Int, advance: Advance = unheard) -> None:
        """Ask the field for all nodes of the given leaves, of shape (N, 3), and keep them."""
        nodes = (leaves[:, None] * LEAF + _LEAF_NODES).reshape(-1, 3)
        values = self.lattice.values(nodes, self.slope, advance)
        values = np.clip(np.where(np.abs(values) < NUDGE, np.where(values < 0, -NUDGE, NUDGE), values), -LIMIT, LIMIT)
        self.rows[tuple(leaves.T)] = len(self.store) + np.arange(len(leaves), dtype=np.int32)
        self.store = np.concatenate([self.store, values.reshape(-1, LEAF, LEAF, LEAF)])

    def missing(self, chunk: Int) -> Int:
        """Leaves, of shape (N, 3), that hold an unevaluated corner of a cell with a sign change in this chunk."""
        leaves = self.leaves(chunk)
        if (leaves >= FIRST).all() or (leaves == OUTSIDE).all() or (leaves == INSIDE).all():
            return np.empty((0, 3), dtype=np.int64)
        negative = self.nodes(chunk) < 0
        unknown = (leaves < FIRST).repeat(LEAF, 0).repeat(LEAF, 1).repeat(LEAF, 2)
        unknown = unknown[: CHUNK + 1, : CHUNK + 1, : CHUNK + 1]
        corners = [tuple(slice(o, o + CHUNK) for o in corner) for corner in _CORNERS]
        crossed = np.logical_or.reduce([negative[c] for c in corners])
        crossed &= ~np.logical_and.reduce([negative[c] for c in corners])
        wanted = np.zeros_like(negative)
        for corner in corners:
            wanted[corner] |= crossed & unknown[corner]
        return np.unique(np.argwhere(wanted) // LEAF, axis=0) + chunk * _LEAVES


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
    counts = -(-(lattice.cells + 1) // CHUNK)
    rows = np.full(counts * _LEAVES + 1, OUTSIDE, dtype=np.int32)
    store = np.full((FIRST, LEAF, LEAF, LEAF), LIMIT)
    store[INSIDE] = -LIMIT
    blocks = np.stack(np.meshgrid(*map(np.arange, counts * (CHUNK // COARSE)), indexing="ij"), -1).reshape(-1, 3)
    centers = (blocks * COARSE + COARSE / 2).astype(np.float64)
    slope = _lipschitz(lattice, centers)
    values = lattice.values(centers, slope)
    advance(LOCATED / 2)
    band = Band(lattice, slope, rows, store)
    tree = None if data is None else _tree(data)
    size = COARSE
    while True:
        half_diagonal = size * np.sqrt(3) / 2
        near = np.abs(values) <= half_diagonal
        if tree is not None:
            # A block at the box's border also holds nodes beyond it, which are outside whatever its centre is.
            inner = near & ((blocks > 0) & ((blocks + 1) * size < lattice.cells)).all(axis=1)
            near[inner] = tree.query(blocks[inner] * size + size / 2)[0] <= half_diagonal + REACH
        _mark_inside(rows, blocks[~near & (values < 0)], size // LEAF)
        if size == LEAF:
            break
        size //= 2
        blocks = (blocks[near][:, None] * 2 + np.array(_CORNERS)).reshape(-1, 3)
        values = lattice.values(blocks * size + size / 2, slope)
    band.evaluate(blocks[near], part(advance, LOCATED, 1.0))
    _propagate(band)
    return band


def _tree(data: Float) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(data)


def _lipschitz(lattice: Lattice, centers: Float) -> float:
    """Bound on the slope: a high percentile of the gradient's length, with a quarter more.

    Half of the samples are the block centres nearest to the surface, half are spread over the whole box.
    """
    half = 2048
    nearest = np.argsort(np.abs(lattice.values(centers, 1.0)), kind="stable")[:half]
    spread = np.arange(0, len(centers), -(-len(centers) // half))
    slopes = lattice.slopes(centers[np.union1d(nearest, spread)])
    # A field that is constant at all samples has no slope there; any positive number keeps the division defined.
    return max(1.25 * float(np.percentile(slopes, 99.5)), 1e-6)


def _mark_inside(rows: npt.NDArray[np.int32], blocks: Int, leaves: int) -> None:
    """Mark all leaves of the given blocks, each `leaves` leaves a side, as inside."""
    for offset in itertools.product(range(leaves), repeat=3):
        rows[tuple((blocks * leaves + offset).T)] = INSIDE


def _propagate(band: Band) -> None:
    """Evaluate further leaves until every corner of every cell with a sign change has its own value."""
    queue = band.chunks()
    while len(queue):
        found = [band.missing(chunk) for chunk in queue]
        leaves = np.unique(np.concatenate(found), axis=0)
        if not len(leaves):
            return
        band.evaluate(leaves)
        # A new value also changes cells of the lower neighbours, whose upper corners it is.
        touched = ((leaves[:, None] - np.array(_CORNERS)) // _LEAVES).reshape(-1, 3)
        queue = np.unique(touched[(touched >= 0).all(axis=1)], axis=0)
