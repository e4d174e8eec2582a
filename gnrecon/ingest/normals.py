"""Directions of normals, without their sign, from neighbourhoods that suit the scan at each point.

The direction at a point is the least principal axis of its neighbours (Hoppe et al. 1992). How many of them, the scan
decides: noise of standard deviation s along the normal turns the plane of k neighbours within a radius r by about
2 s / (r sqrt(k)), so that the fewest are taken with which this stays small (after Mitra and Nguyen, *Estimating Surface
Normals in Noisy Point Cloud Data*, 2003). The noise is the spread about a quadric, so that curvature is not taken for
it, and of the neighbours' the least but two counts, because an edge or a second sheet nearby is no noise.

A plane that straddles a sharp edge fits badly where one beside it fits well. Where a neighbour's plane holds the point,
and fits its own neighbours far better than the point's own plane does, it is taken instead (after Kuwahara's filter of
images).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.local_pca import principal_axes, tangent_coordinates
from gnrecon.runtime.chunks import slices

_NEIGHBOURS = (12, 24, 48)

_FIRST, _MORE = 8, 16
"""The first of these is at most an eighth of all points, the others a sixteenth: a plane must not span the shape."""

_TURN = 0.06
"""Radians that noise may turn a normal by before more neighbours are asked."""

_QUADRIC, _AROUND = 6, 24

_RANK = 2

_NARROW = 10
"""Neighbours of the planes that stand in beside an edge."""

_FAR_BETTER = 10.0

_OFF_PLANE = 4.0

_CHUNK = 50_000

_LEAST = np.finfo(np.float64).tiny


# Directions of normals, without their sign, from neighbourhoods that suit the scan at each point.
#
# The direction at a point is the least principal axis of its neighbours (Hoppe et al. 1992). How many of them, the scan
# decides: noise of standard deviation s along the normal turns the plane of k neighbours within a radius r by about 2 s
# / (r sqrt(k)), so that the fewest are taken with which this stays small (after Mitra and Nguyen, *Estimating Surface
# Normals in Noisy Point Cloud Data*, 2003). The noise is the spread about a quadric, so that curvature is not taken for
# it, and of the neighbours' the least but two counts, because an edge or a second sheet nearby is no noise.
#
# A plane that straddles a sharp edge fits badly where one beside it fits well. Where a neighbour's plane holds the
# point, and fits its own neighbours far better than the point's own plane does, it is taken instead (after Kuwahara's
# filter of images).
def unoriented_normals(points: Float) -> Float:
    """Return unit normals of either sign, of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, centred, N > 3
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    around = min(_AROUND, len(points))
    sizes = _sizes(len(points))
    distances = np.empty((len(points), around), np.float32)
    rows = np.empty((len(points), around), np.int32)
    for chunk in slices(len(points), _CHUNK):
        distances[chunk], rows[chunk] = tree.query(points[chunk], around)
    noise = _noise(points, rows, distances)
    found, left = np.empty_like(points), np.arange(len(points))
    for size in sizes:
        last = size == sizes[-1]
        for asked in np.array_split(left, max(1, len(left) // _CHUNK)):
            gaps, near = (distances[asked], rows[asked]) if size <= around else tree.query(points[asked], size)
            turn = 2 * noise[asked] / np.maximum(gaps[:, size - 1] * np.sqrt(size), _LEAST)
            suits = (turn < _TURN) | last
            found[asked[suits]] = _planes(points, near[suits, :size])[1]
            left = left[~np.isin(left, asked[suits], assume_unique=True)]
    return _beside_edges(points, rows, found)


def tangent_planes(points: Float, neighbours: int) -> Float:
    """Return unit normals of either sign, of shape (N, 3), each of the plane of as many neighbours."""
    from scipy.spatial import cKDTree

    tree, size = cKDTree(points), min(neighbours, max(4, len(points) // _FIRST))
    chunks = slices(len(points), _CHUNK)
    return np.concatenate([_planes(points, tree.query(points[chunk], size)[1])[1] for chunk in chunks])


def _sizes(count: int) -> list[int]:
    first = min(_NEIGHBOURS[0], max(4, count // _FIRST))
    return [first, *(size for size in _NEIGHBOURS[1:] if size <= count // _MORE)]


def _planes(points: Float, rows: Int) -> tuple[Float, Float, Float]:
    """Return centroids and unit normals, of shape (G, 3), and variances along three axes, of groups of rows (G, k)."""
    groups = points[rows]
    variances, axes = principal_axes(groups, covariance=True)
    return groups.mean(axis=1), axes[:, :, 0], np.maximum(variances, 0.0)


def _noise(points: Float, rows: Int, distances: npt.NDArray[np.float32]) -> Float:
    """Return the standard deviation along the normal, of shape (N,)."""
    own = np.empty(len(points))
    for chunk in slices(len(points), _CHUNK):
        own[chunk] = _off_quadric(points[rows[chunk]]) * distances[chunk, -1]
    least = np.empty(len(points))
    rank = min(_RANK, rows.shape[1] - 1)
    for chunk in slices(len(points), _CHUNK):
        least[chunk] = np.partition(own[rows[chunk]], rank, axis=1)[:, rank]
    return least


def _off_quadric(groups: Float) -> Float:
    """Return how far groups, of shape (G, k, 3), spread about quadrics, of shape (G,), in units of their reach."""
    u, v, w = np.moveaxis(tangent_coordinates(groups), 2, 0)
    columns = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    # A trace on the diagonal, because points on a line leave the quadric open.
    product = np.einsum("gka,gkb->gab", columns, columns) + 1e-9 * np.eye(_QUADRIC)
    factors = np.linalg.solve(product, np.einsum("gka,gk->ga", columns, w)[:, :, None])[:, :, 0]
    rest = w - np.einsum("gka,ga->gk", columns, factors)
    free = max(groups.shape[1] - _QUADRIC, 1)
    return np.asarray(np.sqrt((rest**2).sum(axis=1) / free))


def _beside_edges(points: Float, rows: Int, found: Float) -> Float:
    """Return the directions, those beside an edge replaced by a neighbour's that does not straddle it."""
    near = rows[:, : min(_NARROW, rows.shape[1], max(4, len(points) // _FIRST))]
    centroids, normals, variances = (np.empty(shape) for shape in (points.shape, points.shape, points.shape))
    for chunk in slices(len(points), _CHUNK):
        centroids[chunk], normals[chunk], variances[chunk] = _planes(points, near[chunk])
    flatness, across = variances[:, 0], np.maximum(variances[:, 1], _LEAST)
    result = found.copy()
    for chunk in slices(len(points), _CHUNK):
        beside = near[chunk]
        off = np.einsum("gci,gci->gc", points[chunk, None] - centroids[beside], normals[beside])
        score = (flatness[beside] + _OFF_PLANE * off**2) / across[beside]
        best = score.argmin(axis=1)
        each = np.arange(len(best))
        better = flatness[chunk] / across[chunk] > _FAR_BETTER * score[each, best]
        result[chunk][better] = normals[beside[each, best]][better]
    return result
