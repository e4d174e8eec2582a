"""Unoriented normals, from tangent planes of neighbourhoods whose size adapts to the noise.

The normal is the last principal axis of the neighbours (`gnrecon.geometry.local_pca`). Noise of standard deviation s
along the normal turns the plane of k neighbours within a radius r by about 2 s / (r sqrt(k)); the smallest k is used
for which this angle is small (after Mitra and Nguyen, *Estimating Surface Normals in Noisy Point Cloud Data*, 2003).
The noise is the spread about a quadric, so that curvature does not count as noise, and the third smallest value among
the neighbours', because an edge or a second sheet nearby is not noise.

A plane across a sharp edge fits badly, while planes on either side fit well. Where the plane of a neighbour contains
the point, and fits its own neighbours far better than the point's plane does, it replaces that plane (after Kuwahara's
image filter).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.local_pca import principal_axes, quadric_terms, tangent_coordinates
from gnrecon.ingest.ingest_parameters import NormalParameters
from gnrecon.runtime.chunks import slices


def unoriented_normals(points: Float, *, parameters: NormalParameters = NormalParameters()) -> Float:
    """Return unit normals of either sign, of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, centred, N > 3
    parameters : tuning constants
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    around = min(parameters.quadric_neighbours, len(points))
    sizes = _sizes(len(points), parameters)
    distances = np.empty((len(points), around), np.float32)
    rows = np.empty((len(points), around), np.int32)
    for chunk in slices(len(points), parameters.chunk_points):
        distances[chunk], rows[chunk] = tree.query(points[chunk], around)
    noise = _noise(points, rows, distances, parameters)
    normals, left = np.empty_like(points), np.arange(len(points))
    for size in sizes:
        last = size == sizes[-1]
        for some in np.array_split(left, max(1, len(left) // parameters.chunk_points)):
            gaps, near = (distances[some], rows[some]) if size <= around else tree.query(points[some], size)
            turn = 2 * noise[some] / np.maximum(gaps[:, size - 1] * np.sqrt(size), np.finfo(np.float64).tiny)
            enough = (turn < parameters.most_turn_radians) | last
            normals[some[enough]] = _planes(points, near[enough, :size])[1]
            left = left[~np.isin(left, some[enough], assume_unique=True)]
    return _across_edges(points, rows, normals, parameters)


def tangent_planes(points: Float, neighbours: int, *, parameters: NormalParameters = NormalParameters()) -> Float:
    """Return unit normals of either sign, of shape (N, 3), of the planes of a fixed number of neighbours."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    size = min(neighbours, max(4, len(points) // parameters.points_per_first_neighbour))
    chunks = slices(len(points), parameters.chunk_points)
    return np.concatenate([_planes(points, tree.query(points[chunk], size)[1])[1] for chunk in chunks])


def _sizes(count: int, parameters: NormalParameters) -> list[int]:
    """Return the numbers of neighbours to try among `count` points."""
    smallest, *larger = parameters.neighbours
    first = min(smallest, max(4, count // parameters.points_per_first_neighbour))
    return [first, *(size for size in larger if size <= count // parameters.points_per_more_neighbours)]


def _planes(points: Float, rows: Int) -> tuple[Float, Float, Float]:
    """Return centroids and unit normals, of shape (G, 3), and variances along three axes, of groups of rows (G, k)."""
    groups = points[rows]
    variances, axes = principal_axes(groups, covariance=True)
    return groups.mean(axis=1), axes[:, :, 0], np.maximum(variances, 0.0)


def _noise(points: Float, rows: Int, distances: npt.NDArray[np.float32], parameters: NormalParameters) -> Float:
    """Return the standard deviation along the normal, of shape (N,)."""
    own = np.empty(len(points))
    for chunk in slices(len(points), parameters.chunk_points):
        own[chunk] = _off_quadric(points[rows[chunk]]) * distances[chunk, -1]
    least = np.empty(len(points))
    rank = min(parameters.noise_rank, rows.shape[1] - 1)
    for chunk in slices(len(points), parameters.chunk_points):
        least[chunk] = np.partition(own[rows[chunk]], rank, axis=1)[:, rank]
    return least


def _off_quadric(groups: Float) -> Float:
    """Return the deviation of groups, of shape (G, k, 3), from quadrics, of shape (G,), in units of their reach."""
    u, v, w = np.moveaxis(tangent_coordinates(groups), 2, 0)
    columns = quadric_terms(u, v)
    count = columns.shape[2]
    # A small diagonal, because points on a line do not determine a quadric.
    product = np.einsum("gka,gkb->gab", columns, columns) + 1e-9 * np.eye(count)
    factors = np.linalg.solve(product, np.einsum("gka,gk->ga", columns, w)[:, :, None])[:, :, 0]
    rest = w - np.einsum("gka,ga->gk", columns, factors)
    freedom = max(groups.shape[1] - count, 1)
    return np.asarray(np.sqrt((rest**2).sum(axis=1) / freedom))


def _across_edges(points: Float, rows: Int, found: Float, parameters: NormalParameters) -> Float:
    """Return the normals, those of planes across a sharp edge replaced by a neighbour's on one side of it."""
    most = max(4, len(points) // parameters.points_per_first_neighbour)
    near = rows[:, : min(parameters.edge_neighbours, rows.shape[1], most)]
    centroids, normals, variances = (np.empty(shape) for shape in (points.shape, points.shape, points.shape))
    for chunk in slices(len(points), parameters.chunk_points):
        centroids[chunk], normals[chunk], variances[chunk] = _planes(points, near[chunk])
    flatness, across = variances[:, 0], np.maximum(variances[:, 1], np.finfo(np.float64).tiny)
    result = found.copy()
    for chunk in slices(len(points), parameters.chunk_points):
        others = near[chunk]
        off = np.einsum("gci,gci->gc", points[chunk, None] - centroids[others], normals[others])
        # Neighbours on a line have no plane, and a score that may overflow to infinity.
        with np.errstate(over="ignore"):
            score = (flatness[others] + parameters.off_plane_weight * off**2) / across[others]
        best = score.argmin(axis=1)
        each = np.arange(len(best))
        better = flatness[chunk] / across[chunk] > parameters.edge_fit_ratio * score[each, best]
        result[chunk][better] = normals[others[each, best]][better]
    return result
