"""Standard deviation of a cloud's noise along the normal, from the spread of points about local quadrics.

A quadric is fitted to neighbourhoods of two sizes. The variance of noise is the same in both; the surface's own
remainder is of third order, so its square grows with the sixth power of the reach. The two sizes separate both
(Richardson's extrapolation). The variance of each size is the median over the cloud, divided by the median of the
chi-square distribution, so that edges and outliers have little influence. Where noise is large against the
neighbourhoods, their planes are not those of the surface and the spread is too small; the neighbourhoods are doubled
until they reach six times as far as the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.local_pca import quadric_terms, tangent_coordinates
from gnrecon.ingest.ingest_parameters import NoiseParameters


@dataclass(frozen=True)
class Noise:
    """Noise along the normal, in the unit of the points.

    Parameters
    ----------
    deviation : standard deviation; 0 where the surface explains all of the spread; None where it cannot be determined,
        because neighbourhoods that are wide enough would span much of the shape
    limit : upper limit, because part of the spread may be the surface's own
    """

    deviation: float | None
    limit: float


def estimate_noise(points: Float, spacing: float, *, parameters: NoiseParameters = NoiseParameters()) -> Noise:
    """Return the noise of a cloud.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= 16
    spacing : of the points
    parameters : tuning constants
    """
    tree = cKDTree(points)
    chosen = points[np.random.default_rng(0).permutation(len(points))[: parameters.queries]]
    for doubling in range(parameters.most_doublings + 1):
        some = chosen[: max(parameters.least_queries, parameters.queries >> doubling)]
        small = _spread(tree, some, parameters.small_neighbourhood << doubling)
        large = _spread(tree, some, parameters.large_neighbourhood << doubling)
        reached = small[1] >= parameters.least_reach_deviations * small[0]
        next_size = parameters.large_neighbourhood << doubling + 1
        if reached or next_size * parameters.points_per_neighbour > len(points):
            break
    deviation = _extrapolated(*small, *large)
    rounding = parameters.rounding_spacings * spacing
    if not reached and deviation > rounding:
        return Noise(None, max(small[0], deviation))
    return Noise(0.0 if deviation <= rounding else deviation, max(small[0], deviation))


def _extrapolated(near: float, near_reach: float, far: float, far_reach: float) -> float:
    """Return the spread in the limit of a neighbourhood of no extent."""
    a, b = near_reach**6, far_reach**6
    return float(np.sqrt(max(near**2 * b - far**2 * a, 0.0) / (b - a))) if b > a else near


def _spread(tree: cKDTree, chosen: Float, size: int) -> tuple[float, float]:
    """Return the spread about quadrics through `size` points, and the reach of these points; both in the median."""
    distances, rows = tree.query(chosen, size)
    u, v, w = np.moveaxis(tangent_coordinates(tree.data[rows]), 2, 0)
    columns = quadric_terms(u, v)
    basis = np.linalg.qr(columns)[0]
    rest = w - np.einsum("gkc,gc->gk", basis, np.einsum("gkc,gk->gc", basis, w))
    freedom = size - columns.shape[2]
    squares = (rest**2).sum(axis=1) * distances[:, -1] ** 2
    # Median of chi squared; scipy.stats has it too, but takes as long to import as the rest of scipy.
    median = 2 * gammaincinv(freedom / 2, 0.5)
    return float(np.sqrt(np.median(squares) / median)), float(np.median(distances[:, -1]))
