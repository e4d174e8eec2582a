"""The distances between neighbouring points: of each, and what is typical of all."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float

_QUERIES = 20_000
_NEIGHBOURS = 8


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
    stride = -(-len(points) // _QUERIES)
    distances: Float = cKDTree(centred).query(centred[::stride], count + 1)[0][:, 1:]
    return distances
