"""How the normals of neighbours agree: along a sheet, at thin walls, and where signs are wrong.

Two normals oppose each other where they are more than 120 degrees apart, so that no edge of a solid counts. At a thin
wall with outward normals the opposing neighbour lies behind the point. Where signs change within one sheet, it lies in
front as often: the height of the one over the other's plane changes its sign with the normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.geometry.arrays import Float, Mask


@dataclass(frozen=True)
class Agreement:
    """How neighbours' normals agree, in shares of pairs of near points.

    Parameters
    ----------
    opposing : share of the pairs whose normals oppose each other
    conflicting : the same of those where the neighbour lies neither behind the point nor across a gap from it
    contradicted : share of the points with which half of the neighbours or more conflict
    depth_variation : standard deviation, over the mean, of the depths of the opposing neighbours of a point below its
        plane, in the median; infinite where hardly any neighbours oppose each other
    """

    opposing: float
    conflicting: float
    contradicted: float
    depth_variation: float

    def lie_behind(self, *, most_conflicting_share: float = 0.1) -> bool:
        """Return whether neighbours that oppose each other lie behind, as on both sides of a wall.

        Signs that change within sheets have 0.2 to 0.5 of the opposing pairs in conflict, thin walls 0 to 0.07.
        """
        return self.conflicting <= most_conflicting_share * self.opposing

    def shows_walls(self, *, least_opposing: float = 0.02, most_depth_variation: float = 0.3) -> bool:
        """Return whether many normals oppose each other, as on both sides of a thin wall that is thicker than noise.

        Signs by the winding number may also divide the noise of one sheet into a wall; normally distributed heights
        that are divided in the middle have a depth variation of 0.38, thin walls of up to 0.25.
        """
        thick = self.depth_variation <= most_depth_variation
        return self.opposing >= least_opposing and self.lie_behind() and thick


def agreement_of(
    points: Float,
    normals: Float,
    *,
    neighbours: int = 8,
    queries: int = 10_000,
    opposing_cosine: float = -0.5,
    least_height: float = 1e-6,
    gap_height: float = 0.5,
) -> Agreement:
    """Return how the normals of neighbours agree.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), N > 1; normals of unit length
    neighbours : of a point
    queries : random points at which it is measured
    opposing_cosine : of the angle beyond which normals oppose each other
    least_height : of a neighbour below the plane of a point, over their distance, to lie behind it; above rounding
    gap_height : of a neighbour above that plane, over their distance, to lie across a gap, as on the other wall of a
        slot; on one sheet noise is less than half of the spacing
    """
    from scipy.spatial import cKDTree

    some = np.random.default_rng(0).permutation(len(points))[:queries]
    distances, near = cKDTree(points).query(points[some], min(neighbours + 1, len(points)))
    # The first neighbour is the point itself, or a copy of it.
    distances, near = distances[:, 1:], near[:, 1:]
    opposing = np.einsum("gki,gi->gk", normals[near], normals[some]) < opposing_cosine
    heights = np.einsum("gki,gi->gk", points[near] - points[some, None], normals[some])
    conflicting = opposing & (heights >= -least_height * distances) & (heights <= gap_height * distances)
    return Agreement(
        float(opposing.mean()),
        float(conflicting.mean()),
        float((conflicting.mean(axis=1) >= 0.5).mean()),
        _depth_variation(heights, opposing),
    )


def _depth_variation(heights: Float, opposing: Mask, *, least_neighbours: int = 3) -> float:
    """Return the deviation over the mean of the opposing neighbours' heights, of shape (G, k), in the median."""
    count = opposing.sum(axis=1)
    heights, opposing, count = (values[count >= least_neighbours] for values in (heights, opposing, count))
    means = np.where(opposing, heights, 0.0).sum(axis=1) / count
    squares = (np.where(opposing, heights - means[:, None], 0.0) ** 2).sum(axis=1) / (count - 1)
    solid = means != 0
    return float(np.median(np.sqrt(squares[solid]) / np.abs(means[solid]))) if solid.any() else np.inf


def sheet_thickness(
    points: Float,
    normals: Float,
    noise: float = 0.0,
    *,
    neighbours: int = 16,
    least_behind: int = 2,
    queries: int = 10_000,
    least_depth_deviations: float = 4.0,
    least_share: float = 0.02,
    percentile: float = 10.0,
) -> float | None:
    """Return the thickness of the thinnest sheets that two opposite layers of points show; None where there are none.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3); outward unit normals
    noise : standard deviation of the points along the normal, in their unit
    neighbours : of a point, among which the layer behind it is looked for; farther layers are far for the spacing
    least_behind : of the neighbours, in a layer behind a point: one alone may have a wrong normal, as at an edge
    queries : random points at which it is measured
    least_depth_deviations : of the noise, of a layer behind a point: less may be the noise of the two points alone
    least_share : of these with a layer behind them, below which it may be noise
    percentile : of the depths of these layers
    """
    from scipy.spatial import cKDTree

    some = np.random.default_rng(0).permutation(len(points))[:queries]
    near = cKDTree(points).query(points[some], min(neighbours + 1, len(points)))[1]
    depths = -np.einsum("gki,gi->gk", points[near] - points[some, None], normals[some])
    behind = (np.einsum("gki,gi->gk", normals[near], normals[some]) < -0.9) & (depths > least_depth_deviations * noise)
    found = np.flatnonzero(behind.sum(axis=1) >= least_behind)
    if len(found) < least_share * len(some):
        return None
    depths = np.where(behind, depths, 0.0)[found].sum(axis=1) / behind[found].sum(axis=1)
    return float(np.percentile(depths, percentile))
