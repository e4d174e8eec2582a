"""A scan that is in a cloud twice, to within rounding: copies of points that no surface can tell apart.

By chance two points of a surface may lie close together, but hardly ever a fiftieth of the way to their sixteenth
neighbour: that holds for less than one point in a hundred. Where it does for many, the scan is repeated, as by files
that were merged twice or posed by rounded numbers, and the first of each group stays. Spacing and noise would else be
those of the copies. Repetitions that lie farther apart are layers (`layers`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask

_NEIGHBOURS = 16
_CLOSE = 0.02  # of the distance to the sixteenth neighbour
_QUERIES = 20_000
_SHARE = 0.05
"""Of points that have a close one, from which on the scan is repeated."""


def repeated_points(points: Float) -> Mask:
    """Return the mask, of shape (N,), of points that repeat an earlier one; none where it is not the whole scan.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    tree, stride = cKDTree(points), -(-len(points) // _QUERIES)
    count = min(_NEIGHBOURS, len(points) - 1)
    if count < 1 or _close(tree, points[::stride], count)[1].any(axis=1).mean() < _SHARE:
        return np.zeros(len(points), bool)
    neighbours, close = _close(tree, points, count)
    rows, columns = np.nonzero(close)
    pairs = (np.ones(len(rows), np.int8), (rows, neighbours[rows, columns]))
    links: Any = coo_matrix(pairs, shape=(len(points), len(points)))
    groups = connected_components(links, directed=False)[1]
    mask = np.ones(len(points), bool)
    mask[np.unique(groups, return_index=True)[1]] = False
    return mask


def _close(tree: Any, queries: Float, count: int) -> tuple[Int, Mask]:
    """The nearest other points of each, of shape (Q, count), and which of them are as good as the same."""
    distances, neighbours = tree.query(queries, count + 1)
    return neighbours[:, 1:], distances[:, 1:] < _CLOSE * distances[:, -1:]
