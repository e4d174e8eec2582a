"""Isolated clusters: a few points together, off all others, as of dust, reflections or what stood in the background.

Points are together where they are nearer than ten spacings of the cloud. Of the parts that this gives, those with fewer
than one in a hundred points are looked at once more: they are joined to what is nearer than four of their own spacings,
so that a region that was scanned thinly does not fall apart. One that is still a part is isolated if it is farther from
the rest than it is large: a real part that is thin, or a strip whose surroundings were not seen, is longer than its
gap. What has fewer than five points is left to the outliers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.ingest.spacing import neighbour_spacing
from gnrecon.ingest.voxel import cells_of

_NEAR_ALL = 10.0
_CELLS = 4
"""Cubes along the greatest distance of points that are together."""

_NEIGHBOURS = 16
_OWN = 4  # neighbours, the farthest of which tells a point's own spacing
_NEAR_OWN = 4.0
_SHARE = 0.01


def isolated_clusters(points: Float) -> Mask:
    """Return the mask, of shape (N,), of points in isolated clusters.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    """
    if len(points) <= _NEIGHBOURS:
        return np.zeros(len(points), bool)
    links = _near_links(points, _NEAR_ALL * neighbour_spacing(points))
    parts, small = _parts(links, len(points))
    if small.any():
        parts, small = _parts(np.hstack([links, _own_links(points, np.flatnonzero(small[parts]))]), len(points))
    # A part that stays may be what keeps another from being alone.
    while small.any() and not small.all():
        stays = small & ~_alone(points, parts, small)
        small &= ~stays
        if not stays.any():
            return small[parts]
    return np.zeros(len(points), bool)


def _parts(links: Int, count: int) -> tuple[Int, Mask]:
    """The number of each point's part, of shape (N,), and by part whether it is small."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph: Any = coo_matrix((np.ones(links.shape[1], np.int8), links), shape=(count, count))
    parts: Int = connected_components(graph, directed=False)[1].astype(np.intp)
    return parts, np.bincount(parts) < _SHARE * count


def _near_links(points: Float, reach: float) -> Int:
    """Pairs of rows, of shape (2, P), that link points nearer than `reach`, to within its fourth part.

    All points of a small cube are linked with its first one, and first ones among each other: there are few of them.
    """
    from scipy.spatial import cKDTree

    cells = cells_of(points, reach / _CELLS)
    first = np.unique(cells, return_index=True)[1]
    pairs = cKDTree(points[first]).query_pairs(reach, output_type="ndarray")
    return np.hstack([np.stack([np.arange(len(points)), first[cells]]), first[pairs].T])


def _own_links(points: Float, rows: Int) -> Int:
    """Pairs of rows, of shape (2, P), that link points in `rows` to what is near by their own spacing."""
    from scipy.spatial import cKDTree

    distances, neighbours = cKDTree(points).query(points[rows], _NEIGHBOURS + 1)
    near = distances <= _NEAR_OWN * distances[:, [_OWN]]
    first, column = np.nonzero(near)
    return np.stack([rows[first], neighbours[first, column]])


def _alone(points: Float, parts: Int, suspects: Mask) -> Mask:
    """Which of the suspected parts are farther from all that is not suspected than they are large; by part."""
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(suspects[parts])
    numbers, own = np.unique(parts[rows], return_inverse=True)
    gap, lower, upper = np.full(len(numbers), np.inf), *np.full((2, len(numbers), 3), np.inf)
    np.minimum.at(gap, own, cKDTree(points[~suspects[parts]]).query(points[rows])[0])
    np.minimum.at(lower, own, points[rows])
    np.minimum.at(upper, own, -points[rows])
    alone = np.zeros(len(suspects), bool)
    alone[numbers] = gap > np.linalg.norm(-upper - lower, axis=1)
    return alone
