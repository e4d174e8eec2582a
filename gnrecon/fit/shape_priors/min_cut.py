"""Which cells of a lattice are inside, by a minimal cut between those known to be inside and outside.

The area of the cut is the number of neighbouring pairs that it separates, all 26 of a cell, weighted by one over their
distance. Where the cut follows a given surface, from its inside to its outside, it costs less. So faces are extended
until they meet, although a chamfer would have less area.
Sources: Boykov and Kolmogorov, Computing Geodesics and Minimal Surfaces via Graph Cuts (2003); primitives as sides of a
cut: Labatut, Pons and Keriven, Hierarchical Shape-Based Surface Reconstruction (2009). Entry: `minimal_inside`.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from gnrecon.geometry.arrays import Float, Int, Mask


def minimal_inside(
    known: Int, signed: Float, valid: Mask, *, surface_cost: float = 0.1, unit_capacity: int = 1000
) -> Mask:
    """Return which cells of a lattice are inside, of shape (a, b, c).

    Parameters
    ----------
    known : array of shape (a, b, c): 1 inside, -1 outside, 0 where the cut decides
    signed : array of shape (a, b, c, surfaces), signed distances, negative inside
    valid : mask of the same shape, where each surface may be followed
    surface_cost : of a unit of area along a surface, over that of any other: small, so that surfaces are preferred
        even where they have several times the area
    unit_capacity : of a pair one cell apart; the flow solver takes integers, so that weights are rounded to 1/1000
    """
    free = known.ravel() == 0
    count = int(free.sum())
    source, sink = count, count + 1
    node = np.where(known.ravel() > 0, source, sink)
    node[free] = np.arange(count)
    cells = np.arange(known.size).reshape(known.shape)
    inner, followed = signed.reshape(known.size, -1) < 0, valid.reshape(known.size, -1)
    rows, cols, costs = [], [], []
    # Each of the 26 neighbours once: the 13 steps of one half space.
    for step in (step for step in itertools.product((-1, 0, 1), repeat=3) if step > (0, 0, 0)):
        cost = unit_capacity / float(np.linalg.norm(step))
        one, other = shifted(cells, step)
        touches = free[one] | free[other]
        for start, end in ((one[touches], other[touches]), (other[touches], one[touches])):
            # Cut where `start` is inside and `end` is outside.
            along = (inner[start] & ~inner[end] & followed[start]).any(axis=1)
            rows.append(node[start])
            cols.append(node[end])
            costs.append(np.where(along, surface_cost * cost, cost))
    capacity = np.concatenate(costs).astype(np.int32)
    graph = coo_matrix((capacity, (np.concatenate(rows), np.concatenate(cols))), shape=(count + 2, count + 2)).tocsr()
    left = graph - maximum_flow(graph, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    inside = np.zeros(count + 2, dtype=bool)
    inside[breadth_first_order(left, source, return_predecessors=False)] = True
    sides: Mask = inside[node].reshape(known.shape)
    return sides


def shifted(cells: Int, step: tuple[int, ...]) -> tuple[Int, Int]:
    """Return the numbers, each of shape (pairs,), of all cells and of those a step away from them."""
    here = tuple(slice(max(0, -by), size - max(0, by)) for by, size in zip(step, cells.shape, strict=True))
    there = tuple(slice(max(0, by), size - max(0, -by)) for by, size in zip(step, cells.shape, strict=True))
    return cells[here].ravel(), cells[there].ravel()
