"""Points along lines, as the profiles of a laser scanner: normals from several lines, and thinning along the lines.

The nearest points of a point are all on its own line, and the plane through them is arbitrary. So the normal is at
right angles to two directions: that of the line, from the nearest points, and that across, from the nearest points of
the lines on both sides. These are found among points that are thinned by a voxel grid until they lie on lines no more.
Its cubes are then about half as wide as the lines are apart, and the points of one cube serve the fit as well as all:
between the lines nothing finer is known.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.local_pca import principal_axes, principal_sums
from gnrecon.geometry.voxel_grid import voxel_representatives_of_side
from gnrecon.ingest.ingest_parameters import LineParameters
from gnrecon.ingest.point_spacing import mean_spacing
from gnrecon.runtime.chunks import slices


def lie_on_lines(points: Float, *, parameters: LineParameters = LineParameters()) -> bool:
    """Return whether points lie along lines that are far apart, as the profiles of a laser do.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    parameters : tuning constants
    """
    some = np.random.default_rng(0).permutation(len(points))[: parameters.queries]
    return float(_on_line(points, some, parameters).mean()) >= parameters.least_share


def _on_line(points: Float, some: Int, parameters: LineParameters) -> Mask:
    """Return whether the nearest points of some points lie on one line, of shape (Q,)."""
    if len(points) <= parameters.neighbours:
        return np.zeros(len(some), bool)
    near = cKDTree(points).query(points[some], parameters.neighbours)[1]
    sums = np.maximum(principal_sums(points[near]), np.finfo(np.float64).tiny)
    return np.asarray(sums[:, 1] < parameters.most_width_share * sums[:, 2])


def rows_along_lines(points: Float, side: float) -> Int:
    """Return the row of a point in each cube of a side, in the order of the points, an array of shape (N, 3)."""
    return np.sort(voxel_representatives_of_side(points, side, np.random.default_rng(0)))


def thinned_along_lines(points: Float, *, parameters: LineParameters = LineParameters()) -> tuple[Int, float]:
    """Return the rows of a part of the points that does not lie on lines, in their order, and the side of its cubes.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    parameters : tuning constants
    """
    rng, side = np.random.default_rng(0), mean_spacing(points)
    rows: Int = np.arange(len(points))
    while True:
        side *= parameters.growth
        fewer = rows_along_lines(points, side)
        if len(fewer) < parameters.least_points:
            return rows, side / parameters.growth
        rows = fewer
        some = rng.permutation(len(rows))[: parameters.queries]
        if _on_line(points[rows], some, parameters).mean() <= parameters.most_thinned_share:
            return rows, side


def normals_across_lines(
    points: Float, rows: Int, side: float, *, parameters: LineParameters = LineParameters()
) -> tuple[Float, Mask]:
    """Return unit normals of either sign at some of the points, of shape (M, 3), and where there are any.

    There is none where the nearest points do not lie on one line, or none are found on other lines.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    rows : of shape (M,), and
    side : what `thinned_along_lines` returns
    parameters : tuning constants
    """
    tree, thin = cKDTree(points), cKDTree(points[rows])
    count, lines = min(parameters.across_neighbours, len(rows)), _lines(points, tree, side / 2, parameters)[rows]
    normals, found = np.zeros((len(rows), 3)), np.zeros(len(rows), bool)
    for part in slices(len(rows), parameters.chunk_points):
        own = points[rows[part]]
        values, axes = principal_axes(points[tree.query(own, parameters.neighbours)[1]])
        along = axes[:, :, 2]
        distances, near = thin.query(own, count)
        # A bent line comes near itself, so points of other lines go first.
        weights = np.where(lines[near] == lines[part, None], parameters.own_line_weight, 1.0)
        across = _across(points[rows][near] - own[:, None], distances * weights, along, side, parameters)
        normal = np.cross(along, across)
        lengths = np.linalg.norm(normal, axis=1)
        found[part] = (lengths > 0) & (values[:, 1] < parameters.most_own_width_share * values[:, 2])
        normals[part] = normal / np.where(lengths > 0, lengths, 1)[:, None]
    return normals, found


def _lines(points: Float, tree: cKDTree, gap: float, parameters: LineParameters) -> Int:
    """Return the number, from 0, of the line of each point, of shape (N,); lines closer than a gap are one."""
    distances, near = tree.query(points, parameters.neighbours)
    first, column = np.nonzero(distances < gap)
    links = coo_matrix((np.ones(len(first), np.int8), (first, near[first, column])), shape=(len(points),) * 2)
    return np.asarray(connected_components(links, directed=False)[1], np.intp)


def _across(offsets: Float, distances: Float, along: Float, side: float, parameters: LineParameters) -> Float:
    """Return the directions across the lines, of shape (G, 3), at right angles to them; 0 where there is none.

    They are slopes of the parabola through a point and the nearest ones on both sides, or if there is no second one,
    the offset of the first.

    Parameters
    ----------
    offsets, distances : of shape (G, k, 3) and (G, k), of near points; distances on the own line weighted
    along : unit vectors along the lines, of shape (G, 3)
    side : below which near points are on the same line
    parameters : tuning constants
    """
    height, gaps = np.einsum("gki,gi->gk", offsets, along), np.linalg.norm(offsets, axis=2)
    flat = offsets - height[:, :, None] * along[:, None]
    aside = (gaps > side) & (np.abs(height) < parameters.most_along_cosine * gaps)
    each = np.arange(len(along))
    first = np.where(aside, distances, np.inf).argmin(axis=1)
    one = np.where(aside[each, first, None], flat[each, first], 0.0)
    length = np.linalg.norm(one, axis=1)
    lengths = np.linalg.norm(flat, axis=2)
    cosines = np.einsum("gki,gi->gk", flat, one) / np.maximum(lengths * length[:, None], np.finfo(np.float64).tiny)
    reach = parameters.most_second_ratio * distances[each, first, None]
    opposite = aside & (cosines < -parameters.least_opposite_cosine) & (distances < reach)
    second = np.where(opposite, distances, np.inf).argmin(axis=1)
    ratio = np.where(opposite[each, second], lengths[each, second] / np.maximum(length, np.finfo(np.float64).tiny), 1.0)
    other = np.where(opposite[each, second, None], flat[each, second], 0.0)
    return np.asarray(one * ratio[:, None] - other / ratio[:, None])
