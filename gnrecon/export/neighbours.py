"""The scanned points around each vertex, with weights that fade out smoothly.

Of the K + 1 nearest points at distances d_0 <= ... <= d_K, the first K count, by

    w_j = (d_K^2 - d_j^2) exp(-(d_j^2 - d_0^2) / (2 h^2)),    h^2 = mean of (d_j^2 - d_0^2) / 4,

divided by their sum. For a place on an evenly scanned surface h is 0.6 of the spacing of the points; far from it the
weights depend on the directions of the points alone. The first factor lets a point lose its weight before it drops out
of the K nearest, so that an average is continuous over space wherever no two points coincide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Int
from gnrecon.runtime.parallel import slices

COUNT = 8
"""Points that are averaged: about the first ring around a point of an even scan."""

_RING = 6
"""Points whose circle tells the spacing."""

_QUERIES = 20_000

BATCH = 100_000
"""Places that are asked for at once."""


@dataclass(frozen=True)
class Neighbours:
    """Nearest points of some places, with weights.

    Parameters
    ----------
    places : slice
        Which of the places they belong to.
    rows : integer array of shape (N, K)
        The points, nearest first.
    weights : array of shape (N, K)
        Not negative, with the sum one in each row.
    """

    places: slice
    rows: Int
    weights: Float


class Neighbourhood:
    """A search tree over scanned points; rows that are not finite are left out, but keep their numbers.

    Parameters
    ----------
    points : array of shape (N, 3), file units, at least one of them finite
    """

    def __init__(self, points: Float) -> None:
        self._rows: Int = np.flatnonzero(np.isfinite(points).all(axis=1))
        finite = points[self._rows]
        # Far-off coordinates would cancel in the squares of differences.
        self._centre = finite.mean(axis=0)
        self._tree: Any = cKDTree(finite - self._centre)

    def distances(self, places: Float) -> Float:
        """Distance to the nearest point, of shape (V,), from places of shape (V, 3); file units."""
        return np.asarray(self._tree.query(places - self._centre)[0], dtype=np.float64)

    def spacing(self) -> float:
        """Typical distance between neighbouring points, in file units; 0 for a single one.

        It is the side of the square that a point has to itself on a surface, by the circle around it that holds its
        nearest others: the median over at most 20,000 evenly chosen points. On an even grid it is the grid's step.
        """
        count = min(_RING, self._tree.n - 1)
        if not count:
            return 0.0
        some = self._tree.data[:: -(-self._tree.n // _QUERIES)]
        radii = self._tree.query(some, [count + 1])[0][:, 0]
        # A point that has others at its very place says nothing of the distance to the next.
        apart = radii[radii > 0]
        return float(np.sqrt(np.pi / count) * np.median(apart)) if len(apart) else 0.0

    def near(self, places: Float, count: int = COUNT) -> Iterator[Neighbours]:
        """Yield the nearest points of places, of shape (V, 3), some places at a time."""
        most = self._tree.n
        for batch in slices(len(places), BATCH):
            found = self._tree.query(places[batch] - self._centre, list(range(1, min(count + 1, most) + 1)))
            distances, rows = np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.int64)
            kept = slice(None, min(count, most))
            yield Neighbours(batch, self._rows[rows[:, kept]].astype(np.int64), _weights(distances, count))


def _weights(distances: Float, count: int) -> Float:
    """Weights of the first `count` points, of shape (N, count or fewer), for the sorted distances of all."""
    beyond = distances**2 - distances[:, :1] ** 2
    # Where all points are equally far the width is zero, and each counts as much as any other.
    widths = np.maximum(beyond.mean(axis=1, keepdims=True) / 2, np.finfo(np.float64).tiny)
    weights = np.exp(-beyond / widths)
    if distances.shape[1] > count:
        weights = weights[:, :count] * (beyond[:, count:] - beyond[:, :count])
        weights = np.where(weights.sum(axis=1, keepdims=True) > 0, weights, 1.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
