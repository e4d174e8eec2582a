"""Finds the crossings of the edges of a grid with a level set, and the surface area that each represents.

The nodes of a cubic grid of spacing h, shifted at random, are evaluated where f may be zero, and every edge whose ends
differ in sign contains a crossing. It is found by the Illinois variant of regula falsi: the value at an end that is
kept twice counts half, so the bracket never opens and a few trials are enough.

The crossings are not a uniform sample. Lines along axis i, one for each h^2, cross a piece of surface with unit normal
n in proportion to its projection |n_i|; all three families cross it |n_1| + |n_2| + |n_3| times for each h^2. As the
shift is uniform, this is unbiased, so crossings weighted by

    w = h^2 / (|n_1| + |n_2| + |n_3|)

are an unbiased quadrature of the area measure, and their sum is an unbiased estimate of the area (Crofton's formula
of integral geometry for three families of lines; Santalo, Integral Geometry and Geometric Probability, 1976).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.level_set.level_set import LevelSet
from gnrecon.level_set.level_set_parameters import LevelSetParameters


@dataclass(frozen=True)
class Crossings:
    """Points near the level set, on grid edges, in no particular order; there may be none.

    Parameters
    ----------
    points : of shape (N, 3)
    normals : unit, of shape (N, 3)
    areas : w, of shape (N,), in squared units of the coordinates
    spacing : h
    """

    points: Tensor
    normals: Tensor
    areas: Tensor
    spacing: float


def find_crossings(level_set: LevelSet, nodes: int, rng: np.random.Generator) -> Crossings:
    """Search a grid of about `nodes` nodes over the level set's box, shifted at random, for crossings.

    Edges with a value that is not finite are skipped, and so are crossings at which the gradient vanishes.
    """
    sides = level_set.box.upper - level_set.box.lower
    spacing = float(np.prod(sides) / nodes) ** (1 / 3)
    grid = _shifted_nodes(level_set, spacing, rng)
    values = near_values(level_set, grid)
    below, above, at_below, at_above = _brackets(grid, values)
    points = _search(level_set, below, above, at_below, at_above)
    points = points[level_set.contains(points)]
    gradients = level_set.values_and_gradients(points)[1]
    lengths = torch.linalg.vector_norm(gradients, dim=1)
    usable = lengths.isfinite() & (lengths > torch.finfo(lengths.dtype).tiny)
    normals = gradients[usable] / lengths[usable, None]
    return Crossings(points[usable], normals, spacing**2 / normals.abs().sum(1), spacing)


def _shifted_nodes(
    level_set: LevelSet, spacing: float, rng: np.random.Generator, block_cells: int = LevelSetParameters.block_cells
) -> Tensor:
    """Return the nodes, of shape (I, J, K, 3), of a grid of whole blocks that covers the box."""
    lower, upper = level_set.box.lower, level_set.box.upper
    first = lower - spacing * rng.uniform(size=3)
    # Blocks share the nodes on their common faces.
    counts = block_cells * np.ceil((upper - first) / (block_cells * spacing)).astype(int) + 1
    axes = [level_set.tensor(start + spacing * np.arange(n)) for start, n in zip(first, counts, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def near_values(level_set: LevelSet, grid: Tensor, block_cells: int = LevelSetParameters.block_cells) -> Tensor:
    """Return f at the nodes, of shape (I, J, K, 3), of all blocks where it may be zero, and NaN elsewhere.

    Blocks of 3 x 3 x 3 cells are tested at their corners: f may be zero in a block if the least |f| there is at most
    1.5 times the largest change of f along an edge of it or of its neighbours.
    """
    corners = grid[::block_cells, ::block_cells, ::block_cells]
    coarse = level_set.rough_values(corners.reshape(-1, 3)).reshape(corners.shape[:-1])
    wanted = _nodes_of(_may_hold_zero(coarse), grid.shape[:-1], block_cells)
    values = torch.full(grid.shape[:-1], torch.nan, dtype=grid.dtype, device=grid.device)
    values[wanted] = level_set.rough_values(grid[wanted])
    return values


def _may_hold_zero(coarse: Tensor, *, reach_changes: float = 1.5) -> Tensor:
    """Return for each block, (I, J, K), whether f may be zero in it, from f at the corners, (I + 1, J + 1, K + 1).

    `reach_changes` is the largest |f| in units of the change of f along an edge. For a distance function it selects the
    blocks nearer than 1.5 sides, where sqrt(3) / 2 would be enough.
    """
    sizes = torch.zeros_like(coarse)
    for axis in range(3):
        change = coarse.diff(dim=axis).abs().nan_to_num(torch.inf)
        # The change of an edge counts at both of its ends.
        for ends in (slice(0, -1), slice(1, None)):
            part = [slice(None)] * 3
            part[axis] = ends
            sizes[tuple(part)] = torch.maximum(sizes[tuple(part)], change)
    change = _largest(_largest(sizes, 3, 1), 2, 0)
    least = -_largest(-coarse.abs().nan_to_num(torch.inf), 2, 0)
    return least <= reach_changes * change


def _largest(values: Tensor, size: int, padding: int) -> Tensor:
    """Return the largest value in each cube of `size` nodes a side."""
    return torch.nn.functional.max_pool3d(values[None, None], size, stride=1, padding=padding)[0, 0]


def _nodes_of(blocks: Tensor, shape: torch.Size, block_cells: int) -> Tensor:
    """Return which nodes of the grid, of `shape`, belong to the marked blocks, their far faces included."""
    nodes = torch.zeros(shape, dtype=torch.bool, device=blocks.device)
    i, j, k = (block_cells * index for index in blocks.nonzero().T)
    steps = range(block_cells + 1)
    for a, b, c in ((a, b, c) for a in steps for b in steps for c in steps):
        nodes[i + a, j + b, k + c] = True
    return nodes


def _brackets(grid: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the ends where f < 0 and where f >= 0 of all edges that have both, each (N, 3), and f there, (N,)."""
    negative, finite = values < 0, values.isfinite()
    found: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for axis in range(3):
        size = values.shape[axis] - 1
        near = [slice(None)] * 3
        far = [slice(None)] * 3
        near[axis], far[axis] = slice(0, size), slice(1, size + 1)
        a, b = tuple(near), tuple(far)
        for low, high in ((a, b), (b, a)):
            edges = negative[low] & ~negative[high] & finite[low] & finite[high]
            found.append((grid[low][edges], grid[high][edges], values[low][edges], values[high][edges]))
    below, above, at_below, at_above = (torch.cat(parts) for parts in zip(*found, strict=True))
    return below, above, at_below, at_above


def _search(
    level_set: LevelSet, below: Tensor, above: Tensor, at_below: Tensor, at_above: Tensor, *, trials: int = 4
) -> Tensor:
    """Return points, of shape (N, 3), in brackets narrowed by `trials` evaluations with the Illinois rule."""
    # Positions on the edge, from 0 at its lower end to 1 at its upper end.
    low, high = torch.zeros_like(at_below), torch.ones_like(at_below)
    f_low, f_high = at_below.clone(), at_above.clone()
    edge = above - below
    place = _false_position(low, high, f_low, f_high)
    was_low = torch.full_like(place, torch.nan)
    for _ in range(trials):
        value = level_set.rough_values(below + place[:, None] * edge)
        is_low = value < 0
        again = was_low == is_low
        # The value at an end that stays while the other moves twice is halved, so that the next trial crosses the zero.
        f_high = torch.where(is_low, torch.where(again, f_high / 2, f_high), value)
        f_low = torch.where(is_low, value, torch.where(again, f_low / 2, f_low))
        low, high = torch.where(is_low, place, low), torch.where(is_low, high, place)
        was_low = is_low.to(place.dtype)
        place = _false_position(low, high, f_low, f_high)
    return below + place[:, None] * edge


def _false_position(low: Tensor, high: Tensor, f_low: Tensor, f_high: Tensor) -> Tensor:
    """Return where the chord between (low, f_low < 0) and (high, f_high >= 0) is zero."""
    share = f_low / (f_low - f_high).clamp_max(-torch.finfo(f_low.dtype).tiny)
    return low + share.clamp(0.0, 1.0) * (high - low)
