"""The inside of a lattice by a minimal cut: the least surface between what is known inside and what is known outside.

The area of the cut is measured by the pairs of neighbours that it parts, all 26 of them weighted by one over their
distance. Where the cut runs along a surface that is believed in, from its inside to its outside, it costs less; so
faces are continued to where they meet, although a chamfer would be smaller.
Source: Boykov and Kolmogorov, Computing Geodesics and Minimal Surfaces via Graph Cuts (2003); that primitives make
sides of a cut: Labatut, Pons and Keriven, Hierarchical Shape-Based Surface Reconstruction (2009).
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from gnrecon.geometry.arrays import Float, Int, Mask

ALONG = 0.1
"""What an area along a believed surface costs, as a share of any other's."""

UNITS = 1000
"""Integer capacity of a pair one cell apart."""

STEPS = [step for step in itertools.product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]


def minimal_inside(known: Int, signed: Float, believed: Mask) -> Mask:
    """Return which cells of a lattice are inside, of shape (a, b, c).

    Parameters
    ----------
    known : array of shape (a, b, c): 1 inside, -1 outside, 0 where the cut is to tell
    signed : array of shape (a, b, c, surfaces), signed distances, negative inside
    believed : mask of the same shape, where each surface is believed in
    """
    free = known.ravel() == 0
    count = int(free.sum())
    source, sink = count, count + 1
    node = np.where(known.ravel() > 0, source, sink)
    node[free] = np.arange(count)
    cells = np.arange(known.size).reshape(known.shape)
    within, told = signed.reshape(known.size, -1) < 0, believed.reshape(known.size, -1)
    rows, cols, costs = [], [], []
    for step in STEPS:
        cost = UNITS / float(np.linalg.norm(step))
        one, other = shifted(cells, step)
        touches = free[one] | free[other]
        for start, end in ((one[touches], other[touches]), (other[touches], one[touches])):
            # Cut where `start` is inside and `end` is outside.
            along = (within[start] & ~within[end] & told[start]).any(axis=1)
            rows.append(node[start])
            cols.append(node[end])
            costs.append(np.where(along, ALONG * cost, cost))
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
