"""Repeated points: copies within rounding, where a cloud contains the same scan twice.

By chance two points of a surface may lie close together, but less than one point in a hundred has another within a
fiftieth of the distance to its sixteenth neighbour. Where many have, the scan is repeated, as by files that were merged
twice or transformed by rounded numbers, and the first point of each group is kept. Otherwise spacing and noise would be
those of the copies. Repetitions that lie farther apart are double walls (`ingest.double_walls`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask


def repeated_points(
    points: Float,
    *,
    neighbours: int = 16,
    close_share: float = 0.02,
    least_share: float = 0.05,
    least_around: float = 0.5,
    queries: int = 20_000,
) -> Mask:
    """Return the mask, of shape (N,), of points that repeat an earlier one; empty unless the scan is repeated.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    neighbours : searched for copies; the distance of the last one is the measure of closeness
    close_share : of that distance, below which a point is a copy; less than 1 % of a scan's points are so close
    least_share : of points with a copy, from which the scan is repeated; well above this 1 %
    least_around : share of points with a copy among the neighbours of those with one: where a scan is repeated, nearly
        all of them; where strips of a survey overlap, pairs come close by chance, one here and one there
    queries : evenly chosen points that decide whether it is
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    tree, stride = cKDTree(points), -(-len(points) // queries)
    count = min(neighbours, len(points) - 1)
    if count < 1 or _copies(tree, points[::stride], count, close_share)[1].any(axis=1).mean() < least_share:
        return np.zeros(len(points), bool)
    near, close = _copies(tree, points, count, close_share)
    copied = np.asarray(close.any(axis=1), dtype=bool)
    if copied[near[copied]].mean() < least_around:
        return np.zeros(len(points), bool)
    rows, columns = np.nonzero(close)
    pairs = (np.ones(len(rows), np.int8), (rows, near[rows, columns]))
    links: Any = coo_matrix(pairs, shape=(len(points), len(points)))
    groups = connected_components(links, directed=False)[1]
    mask = np.ones(len(points), bool)
    mask[np.unique(groups, return_index=True)[1]] = False
    return mask


def _copies(tree: Any, queries: Float, count: int, close_share: float) -> tuple[Int, Mask]:
    """Return the nearest other points, of shape (Q, count), and which of them are copies of the query."""
    distances, neighbours = tree.query(queries, count + 1)
    return neighbours[:, 1:], distances[:, 1:] < close_share * distances[:, -1:]
