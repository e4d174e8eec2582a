"""Isolated clusters: small groups of points far from all others, such as dust, reflections or background.

Points nearer than ten spacings belong together. Parts with fewer than one in a hundred points are then linked again, to
points within four of their own spacings, so that a thinly scanned region does not fall apart. A part that is still
separate is isolated if its distance from the rest exceeds its own size: a real part that is thin, or a strip whose
surroundings were not seen, is longer than its gap. Groups of fewer than five points are left to the outlier test.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.voxel_grid import cells_of
from gnrecon.ingest.ingest_parameters import IsolatedClusterParameters
from gnrecon.ingest.point_spacing import neighbour_spacing


def isolated_clusters(points: Float, *, parameters: IsolatedClusterParameters = IsolatedClusterParameters()) -> Mask:
    """Return the mask, of shape (N,), of points in isolated clusters.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    parameters : tuning constants
    """
    if len(points) <= parameters.neighbours:
        return np.zeros(len(points), bool)
    reach = parameters.link_spacings * neighbour_spacing(points)
    links = _links_within(points, reach, reach / parameters.cubes_per_link)
    parts, small = _parts(links, len(points), parameters.small_share)
    if small.any():
        links = np.hstack([links, _links_by_own_spacing(points, np.flatnonzero(small[parts]), parameters)])
        parts, small = _parts(links, len(points), parameters.small_share)
    # A part that is kept may be near another suspect, which then is not isolated either.
    while small.any() and not small.all():
        kept = small & ~_far_from_rest(points, parts, small)
        small &= ~kept
        if not kept.any():
            return small[parts]
    return np.zeros(len(points), bool)


def _parts(links: Int, count: int, small_share: float) -> tuple[Int, Mask]:
    """Return the connected component of each point, of shape (N,), and for each component whether it is small."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph: Any = coo_matrix((np.ones(links.shape[1], np.int8), links), shape=(count, count))
    parts: Int = connected_components(graph, directed=False)[1].astype(np.intp)
    return parts, np.bincount(parts) < small_share * count


def _links_within(points: Float, reach: float, cube: float) -> Int:
    """Return pairs of rows, of shape (2, P), that link points nearer than `reach`, to within the side of a cube.

    All points of a cube are linked with its first one, and the first ones with each other, since these are few.
    """
    from scipy.spatial import cKDTree

    cells = cells_of(points, cube)
    first = np.unique(cells, return_index=True)[1]
    pairs = cKDTree(points[first]).query_pairs(reach, output_type="ndarray")
    return np.hstack([np.stack([np.arange(len(points)), first[cells]]), first[pairs].T])


def _links_by_own_spacing(points: Float, rows: Int, parameters: IsolatedClusterParameters) -> Int:
    """Return pairs of rows, of shape (2, P), that link the points in `rows` to points near by their own spacing."""
    from scipy.spatial import cKDTree

    distances, neighbours = cKDTree(points).query(points[rows], parameters.neighbours + 1)
    near = distances <= parameters.own_link_spacings * distances[:, [parameters.own_spacing_neighbour]]
    first, column = np.nonzero(near)
    return np.stack([rows[first], neighbours[first, column]])


def _far_from_rest(points: Float, parts: Int, suspects: Mask) -> Mask:
    """Return which suspected parts are farther from all points that are not suspected than they are large."""
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(suspects[parts])
    numbers, own = np.unique(parts[rows], return_inverse=True)
    gap, lower, upper = np.full(len(numbers), np.inf), *np.full((2, len(numbers), 3), np.inf)
    np.minimum.at(gap, own, cKDTree(points[~suspects[parts]]).query(points[rows])[0])
    np.minimum.at(lower, own, points[rows])
    np.minimum.at(upper, own, -points[rows])
    far = np.zeros(len(suspects), bool)
    far[numbers] = gap > np.linalg.norm(-upper - lower, axis=1)
    return far
