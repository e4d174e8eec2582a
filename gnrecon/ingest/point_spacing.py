"""Distances between neighbouring points: of each point, and typical ones of a cloud."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float


def mean_spacing(points: Float) -> float:
    """Return the median distance to the nearest other point, in the unit of `points`, of shape (N, 3), N > 1.

    In large clouds it is taken over evenly chosen rows.
    """
    return float(np.median(_distances(points, 1)[:, -1]))


def neighbour_spacing(points: Float, *, neighbours: int = 8) -> float:
    """Return the spacing of a square grid as dense as the points on their surface, in the median.

    The disk up to the k-th neighbour holds k points, so each has the area pi r^2 / k, and the spacing is its root. It
    hardly depends on pairs of close points.

    Parameters
    ----------
    points : array of shape (N, 3), N > neighbours
    neighbours : k; those around a point of a grid are 8
    """
    return float(np.median(_distances(points, neighbours)[:, -1]) * np.sqrt(np.pi / neighbours))


def mean_distances(points: Float, *, neighbours: int = 8) -> tuple[Float, int]:
    """Return the mean distance of each point to its nearest others, of shape (N,), and the number of these.

    Parameters
    ----------
    points : array of shape (N, 3), N > 1, with coordinates about the origin
    neighbours : number of others, or all where there are fewer; those around a point of a grid are 8
    """
    from scipy.spatial import cKDTree

    count = min(neighbours, len(points) - 1)
    distances: Float = cKDTree(points).query(points, count + 1)[0][:, 1:]
    return distances.mean(axis=1), count


def _distances(points: Float, count: int, *, queries: int = 20_000) -> Float:
    """Return distances to the `count` nearest others, of shape (Q, count), at up to `queries` evenly chosen rows."""
    from scipy.spatial import cKDTree

    centred = points - points.mean(axis=0)
    stride = -(-len(points) // queries)
    distances: Float = cKDTree(centred).query(centred[::stride], count + 1)[0][:, 1:]
    return distances
