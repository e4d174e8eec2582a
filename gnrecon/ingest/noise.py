"""How noisy a cloud is: the spread of points about smooth patches of their surface, with curvature taken out of it.

A quadric is fitted to neighbourhoods of two sizes. What remains of noise is the same in both; what remains of the
surface, being of third order, grows with the sixth power of the reach in square, so that the two tell both apart
(Richardson's extrapolation). Each size's variance is the median over the cloud, divided by that of the chi-square
distribution, so that edges and outliers count little. Where noise is large against the neighbourhoods, their planes
are not those of the surface and the spread comes out too small; they are doubled until they reach six times as far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.local_pca import tangent_coordinates

_SIZES = (10, 15)
"""Points of the smallest neighbourhoods."""

LEAST_POINTS = 16

_QUERIES, _LEAST_QUERIES = 4000, 500
"""Neighbourhoods that are looked at: the wider, the fewer, because each tells more."""

_WIDE = 6.0  # least reach, in units of the noise

_DOUBLINGS = 6

_SHARE = 32
"""A neighbourhood has no more than one in so many points."""

_NONE = 0.005
"""Of the spacing, below which noise is rounding."""


@dataclass(frozen=True)
class Noise:
    """Noise along the normal, in the unit of the points.

    Parameters
    ----------
    deviation : standard deviation; 0 where the surface itself accounts for all of the spread; None where it cannot be
        told, because neighbourhoods that are wide enough would span much of the shape
    limit : what it is at most, because some of the spread may be the surface's own
    """

    deviation: float | None
    limit: float


def estimate_noise(points: Float, spacing: float) -> Noise:
    """Return the noise of a cloud.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= 16
    spacing : of the points
    """
    tree = cKDTree(points)
    chosen = points[np.random.default_rng(0).permutation(len(points))[:_QUERIES]]
    for doubling in range(_DOUBLINGS + 1):
        some = chosen[: max(_LEAST_QUERIES, _QUERIES >> doubling)]
        small, large = _spread(tree, some, _SIZES[0] << doubling), _spread(tree, some, _SIZES[1] << doubling)
        reached = small[1] >= _WIDE * small[0]
        if reached or (_SIZES[1] << doubling + 1) * _SHARE > len(points):
            break
    deviation = _extrapolated(*small, *large)
    if not reached and deviation > _NONE * spacing:
        return Noise(None, max(small[0], deviation))
    return Noise(0.0 if deviation <= _NONE * spacing else deviation, max(small[0], deviation))


def _extrapolated(near: float, near_reach: float, far: float, far_reach: float) -> float:
    """The spread that a neighbourhood of no reach would have."""
    a, b = near_reach**6, far_reach**6
    return float(np.sqrt(max(near**2 * b - far**2 * a, 0.0) / (b - a))) if b > a else near


def _spread(tree: cKDTree, chosen: Float, size: int) -> tuple[float, float]:
    """The spread about quadrics of `size` points, and how far these reach, in the median."""
    distances, rows = tree.query(chosen, size)
    u, v, w = np.moveaxis(tangent_coordinates(tree.data[rows]), 2, 0)
    columns = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    basis = np.linalg.qr(columns)[0]
    rest = w - np.einsum("gkc,gc->gk", basis, np.einsum("gkc,gk->gc", basis, w))
    freedom = size - columns.shape[2]
    squares = (rest**2).sum(axis=1) * distances[:, -1] ** 2
    # Of chi squared, without scipy.stats, which takes as long to load as the rest of scipy.
    median = 2 * gammaincinv(freedom / 2, 0.5)
    return float(np.sqrt(np.median(squares) / median)), float(np.median(distances[:, -1]))


_SPACING_QUERIES = 20_000

_NEIGHBOURS = 8


# The distances between neighbouring points: of each, and what is typical of all.


def mean_spacing(points: Float) -> float:
    """Return the median distance to the nearest other point, in the unit of `points`, of shape (N, 3), N > 1.

    In large clouds it is taken over evenly chosen rows.
    """
    return float(np.median(_distances(points, 1)[:, -1]))


def neighbour_spacing(points: Float) -> float:
    """Return the distance of points that fill a plane as densely as these fill their surface, in the median.

    It is the side of the square that each point has for itself, from the disk that holds its 8 nearest neighbours, and
    so is hardly moved by pairs of close points; `points` has shape (N, 3), N > 8.
    """
    return float(np.median(_distances(points, _NEIGHBOURS)[:, -1]) * np.sqrt(np.pi / _NEIGHBOURS))


def mean_distances(points: Float) -> tuple[Float, int]:
    """Return the mean distance of each point to its nearest others, of shape (N,), and their number: 8, or all.

    `points` has shape (N, 3), N > 1, with coordinates about the origin.
    """
    from scipy.spatial import cKDTree

    count = min(_NEIGHBOURS, len(points) - 1)
    distances: Float = cKDTree(points).query(points, count + 1)[0][:, 1:]
    return distances.mean(axis=1), count


def _distances(points: Float, count: int) -> Float:
    """Distances to the `count` nearest other points, of shape (Q, count), at evenly chosen rows."""
    from scipy.spatial import cKDTree

    centred = points - points.mean(axis=0)
    stride = -(-len(points) // _SPACING_QUERIES)
    distances: Float = cKDTree(centred).query(centred[::stride], count + 1)[0][:, 1:]
    return distances
