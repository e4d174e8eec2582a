"""Where the zero level may pass: blocks of cells, searched from coarse to fine.

A function whose slope is at most L has no zero in a block of half diagonal d around c when |f(c)| > L d. The coarse
blocks divide the box into some 50 to 100 along its longest side, whatever the resolution is; those that may hold a
zero are halved until they are leaves. L is estimated locally: the length of the gradient at the centre, plus its change
up to the corners by the gradients at neighbouring centres, times 1.25. So where the field is steep or bends, it costs
more evaluations there only. All other blocks keep only the sign of their centre, and what a field still hides between
the centres is found by propagation, see `NarrowBand`.

Where the data is known, only coarse blocks near it are searched. What lies farther off is found by propagation, which
follows the surface from there, so that sheets in free space, where a field is steep, cost little. The entry is
`narrow_band`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.export.export_parameters import ExtractionParameters
from gnrecon.export.lattice import Lattice
from gnrecon.export.leaf_storage import LeafStore, UniformRow, Values
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange


@functools.cache
def cube_nodes(side: int) -> Int:
    """Node offsets of a cube of so many nodes a side, of shape (side^3, 3), ordered along the axes; read only."""
    return np.stack(np.meshgrid(*3 * [np.arange(side)], indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class CellBlocks:
    """Cubes of `size` cells a side.

    Parameters
    ----------
    size : int
    places : integer array of shape (N, 3)
        In units of the size: block (i, j, k) begins at node ``size * (i, j, k)``.
    """

    size: int
    places: Int

    @property
    def centers(self) -> Float:
        """Lattice coordinates of the centres, of shape (N, 3)."""
        return np.asarray((self.places + 0.5) * self.size, dtype=np.float64)

    @property
    def half_diagonal(self) -> float:
        """In cells."""
        return float(self.size * np.sqrt(3) / 2)

    def may_vanish(self, values: Float, slope_bounds: Float | float) -> Mask:
        """Which may hold a zero, of shape (N,), from values at the centres, in cells, and bounds on the slope."""
        # The closing of the field at its box has slope one.
        return np.asarray(np.abs(values) <= np.maximum(slope_bounds, 1.0) * self.half_diagonal)

    def within(self, lattice: Lattice) -> Mask:
        """Which have a node of the lattice, of shape (N,)."""
        return np.asarray((self.places * self.size <= lattice.cells).all(axis=1))

    def split(self) -> CellBlocks:
        """The eight children of each, one parent's after the other's."""
        return CellBlocks(self.size // 2, (self.places[:, None] * 2 + cube_nodes(2)).reshape(-1, 3))

    def __getitem__(self, rows: slice | Mask) -> CellBlocks:
        return CellBlocks(self.size, self.places[rows])


@dataclass(frozen=True)
class CoarseGrid:
    """The coarse blocks of a whole box.

    Parameters
    ----------
    blocks : CellBlocks
        In the order of a grid of shape `grid`.
    grid : tuple of three int
    values : array of shape (N,)
        The field at the centres, in cells.
    steepest : float
        A high percentile of the gradient's length: half of the samples nearest to the surface, half all over the box.
    typical : float
        The median of the gradient's length where the surface may pass.
    """

    blocks: CellBlocks
    grid: tuple[int, ...]
    values: Float
    steepest: float
    typical: float

    @classmethod
    def of(cls, lattice: Lattice, parameters: ExtractionParameters) -> CoarseGrid:
        """Evaluate the field at the centres of coarse blocks, and its gradient at some of them.

        Raises
        ------
        MeshError
            When the field is not finite somewhere.
        """
        size = parameters.leaf_cells
        while lattice.cells.max() > parameters.coarse_blocks * size:
            size *= 2
        grid = lattice.cells // size + 1
        places = np.stack(np.meshgrid(*map(np.arange, grid), indexing="ij"), axis=-1).reshape(-1, 3)
        blocks = CellBlocks(size, places)
        values = lattice.values(blocks.centers, 1.0)
        nearest = np.argsort(np.abs(values), kind="stable")[: parameters.slope_samples]
        spread = np.arange(0, len(values), -(-len(values) // parameters.slope_samples))
        samples = np.union1d(nearest, spread)
        slopes = np.linalg.norm(lattice.gradients(blocks.centers[samples]), axis=1)
        crossed = np.abs(values[samples]) <= slopes * blocks.half_diagonal
        typical = float(np.median(slopes[crossed] if crossed.any() else slopes))
        steepest = float(np.percentile(slopes, parameters.slope_percentile))
        return cls(blocks, tuple(grid), values, steepest, typical)


def candidate_leaves(
    lattice: Lattice, coarse: CoarseGrid, leaves: LeafStore, data: Float | None, parameters: ExtractionParameters
) -> Iterator[tuple[float, Int]]:
    """Yield the leaves, of shape (N, 3), that may hold a zero, by parts, each with the share of the work done after it.

    Parameters
    ----------
    lattice : Lattice
    coarse : CoarseGrid
        Of the same lattice.
    leaves : LeafStore
        Receives the blocks without a zero whose centres are inside.
    data : array of shape (N, 3), lattice coordinates, optional
        Points near which the surface is searched; everywhere when None.
    parameters : ExtractionParameters

    Raises
    ------
    MeshError
        When the field is not finite somewhere.
    """
    blocks, values, margin = coarse.blocks, coarse.values, parameters.slope_margin
    kept = blocks.may_vanish(values, margin * coarse.steepest)
    if data is not None:
        kept[kept] = _near_data(data, blocks[kept], lattice, parameters.data_reach_cells)
    slopes = _slopes(lattice, blocks, kept, (1, *coarse.grid))
    kept &= blocks.may_vanish(values, margin * slopes)
    leaves.mark_inside(blocks.places[~kept & (values < 0)], blocks.size)
    blocks, slopes = blocks[kept], slopes[kept]
    for rows in slices(len(slopes), parameters.batch_blocks):
        yield rows.stop / len(slopes), _subdivide(lattice, leaves, blocks[rows], slopes[rows], margin)


def _subdivide(lattice: Lattice, leaves: LeafStore, blocks: CellBlocks, slopes: Float, margin: float) -> Int:
    """Leaves within the given blocks, in which slopes of shape (N,) were measured; bounds are `margin` times these."""
    while blocks.size > leaves.leaf_cells:
        blocks = blocks.split()
        values = lattice.values(blocks.centers, 1.0)
        kept = blocks.may_vanish(values, margin * slopes.repeat(8)) & blocks.within(lattice)
        if blocks.size > leaves.leaf_cells:
            slopes = _slopes(lattice, blocks, kept, (-1, 2, 2, 2))
            kept &= blocks.may_vanish(values, margin * slopes)
            slopes = slopes[kept]
        else:
            kept &= np.abs(values) <= margin * _corner_variation(values)
        leaves.mark_inside(blocks.places[~kept & (values < 0)], blocks.size)
        blocks = blocks[kept]
    return blocks.places


def _slopes(lattice: Lattice, blocks: CellBlocks, chosen: Mask, shape: tuple[int, ...]) -> Float:
    """Greatest slopes in the chosen blocks, of shape (N,), by the gradients at their centres and at neighbouring ones.

    `shape` arranges the blocks as grids of neighbours, of shape (G, A, B, C). From a centre to a corner the gradient
    changes by half of its differences between neighbours along the three axes. It is 0 for blocks that are not chosen.
    """
    gradients = np.full((len(chosen), 3), np.nan)
    gradients[chosen] = lattice.gradients(blocks.centers[chosen])
    grid = gradients.reshape(*shape, 3)
    slopes = np.linalg.norm(grid, axis=-1)
    for axis in (1, 2, 3):
        steps = np.linalg.norm(np.diff(grid, axis=axis), axis=-1)
        none = np.full_like(slopes.take([0], axis=axis), np.nan)
        before, after = (np.concatenate(pair, axis=axis) for pair in ((none, steps), (steps, none)))
        slopes += 0.5 * np.nan_to_num(np.fmax(before, after))
    return np.asarray(np.nan_to_num(slopes).reshape(-1), dtype=np.float64)


def _corner_variation(values: Float) -> Float:
    """By how much the field varies from the centre of a block to its corners, from the centres of eight siblings.

    Along each axis that is half of the greatest difference between siblings, whose centres lie a block's length apart.
    """
    siblings = values.reshape(-1, 2, 2, 2)
    steps = sum(np.abs(np.diff(siblings, axis=axis)).reshape(-1, 4).max(axis=1) for axis in (1, 2, 3))
    return np.asarray(0.5 * steps).repeat(8)


def _near_data(data: Float, blocks: CellBlocks, lattice: Lattice, reach: float) -> Mask:
    """Which blocks, of shape (N,), have data within so many cells, or lie at the border of the box."""
    # A block at the border also holds nodes beyond it, which are outside whatever its centre is.
    outer = ((blocks.places == 0) | ((blocks.places + 1) * blocks.size >= lattice.cells)).any(axis=1)
    distance = cKDTree(data).query(blocks.centers, distance_upper_bound=blocks.half_diagonal + reach)[0]
    return np.asarray(outer | np.isfinite(distance))


# The narrow band: only the lattice nodes near the zero level are evaluated.
#
# `candidate_leaves` yields the leaves through which the zero level may pass. They are evaluated node by node; all the
# others have only a sign. What that search misses is found by propagation: while a cell with a sign change has a corner
# that was not evaluated, the leaves of its corners are. So every node has exactly one sign, evaluated or not, and
# marching cubes over all of them cannot leave a hole. Memory grows with the surface: about 6 nodes for each vertex.


@dataclass(frozen=True)
class NarrowBand:
    """Node values around the zero level, in cells divided by the typical slope.

    Parameters
    ----------
    lattice : Lattice
    slope : float
        Slope by which values are divided.
    leaves : LeafStore
    parameters : ExtractionParameters
    """

    lattice: Lattice
    slope: float
    leaves: LeafStore
    parameters: ExtractionParameters

    @property
    def nodes(self) -> Int:
        """Offsets of the nodes of a leaf, of shape (K, 3)."""
        return cube_nodes(self.parameters.leaf_cells)

    def values(self, leaves: Int) -> Values:
        """The field at the nodes of leaves, of shape (N, 3): clamped, of shape (N, K)."""
        corners = leaves * self.parameters.leaf_cells
        return self.clamp(self.lattice.values_of_blocks(corners, self.nodes, self.slope))

    def clamp(self, values: Float) -> Values:
        """Return values over the slope, of any shape, kept away from zero and bounded in magnitude."""
        least, greatest = self.parameters.least_node_cells, self.parameters.greatest_node_cells
        away = np.where(np.abs(values) < least, np.where(values < 0, -least, least), values)
        return np.clip(away, -greatest, greatest).astype(np.float32)

    def evaluate(self, leaves: Int, advance: ProgressCallback = ignore_progress) -> None:
        """Evaluate the field at all nodes of the given leaves, of shape (N, 3), and store the values."""
        side = self.parameters.leaf_cells
        for rows in slices(len(leaves), self.lattice.blocks_per_batch(len(self.nodes))):
            advance(rows.start / len(leaves))
            some = leaves[rows]
            self.leaves.store(some, self.values(some).reshape(-1, side, side, side))

    def unevaluated_leaves(self, chunk: Int) -> Int:
        """Leaves, of shape (N, 3), that hold an unevaluated corner of a cell with a sign change in this chunk."""
        side, length = self.parameters.leaf_cells, self.parameters.chunk_cells
        rows = self.leaves.rows(chunk)
        valued = self.leaves.has_values(rows)
        if valued.all() or any((rows == uniform).all() for uniform in UniformRow):
            return np.empty((0, 3), dtype=np.int64)
        negative = self.leaves.nodes(rows) < 0
        unknown = (~valued).repeat(side, 0).repeat(side, 1).repeat(side, 2)[: length + 1, : length + 1, : length + 1]
        corners = [tuple(slice(o, o + length) for o in corner) for corner in itertools.product((0, 1), repeat=3)]
        crossed = np.logical_or.reduce([negative[c] for c in corners])
        crossed &= ~np.logical_and.reduce([negative[c] for c in corners])
        wanted = np.zeros_like(negative)
        for corner in corners:
            wanted[corner] |= crossed & unknown[corner]
        return np.unique(np.argwhere(wanted) // side, axis=0) + chunk * self.leaves.chunk_leaves


def narrow_band(
    lattice: Lattice,
    data: Float | None = None,
    advance: ProgressCallback = ignore_progress,
    *,
    search_time_share: float = 0.1,
    parameters: ExtractionParameters = ExtractionParameters(),
) -> NarrowBand:
    """Evaluate the field where its zero level may pass.

    Parameters
    ----------
    lattice : Lattice
    data : array of shape (N, 3), lattice coordinates, optional
        Points near which the surface is searched; everywhere when None.
    advance : callable
        Receives the share that is done after each batch of points.
    search_time_share : float
        About which share of the time the coarse grid takes, for `advance` only.
    parameters : ExtractionParameters

    Raises
    ------
    MeshError
        When the field is not finite somewhere.
    """
    coarse = CoarseGrid.of(lattice, parameters)
    advance(search_time_share)
    leaves = LeafStore(
        -(-(lattice.cells + 1) // parameters.chunk_cells),
        parameters.greatest_node_cells,
        leaf_cells=parameters.leaf_cells,
        chunk_cells=parameters.chunk_cells,
    )
    # A field that is constant at all samples has no slope there; any positive number keeps the division defined.
    band = NarrowBand(lattice, max(coarse.typical, 1e-6), leaves, parameters)
    done = search_time_share
    for share, found in candidate_leaves(lattice, coarse, leaves, data, parameters):
        begin, done = done, search_time_share + (1.0 - search_time_share) * share
        band.evaluate(found, subrange(advance, begin, done))
    _propagate(band)
    return band


def _propagate(band: NarrowBand) -> None:
    """Evaluate further leaves until every corner of every cell with a sign change has its own value."""
    queue = band.leaves.mixed_chunks()
    while len(queue):
        found = [band.unevaluated_leaves(chunk) for chunk in queue]
        leaves = np.unique(np.concatenate(found), axis=0)
        if not len(leaves):
            return
        band.evaluate(leaves)
        # A new value also changes cells of the lower neighbours, whose upper corners it is.
        touched = ((leaves[:, None] - cube_nodes(2)) // band.leaves.chunk_leaves).reshape(-1, 3)
        queue = np.unique(touched[(touched >= 0).all(axis=1)], axis=0)
