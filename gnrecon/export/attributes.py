"""Carry a scan's colours, labels and measured values over to the vertices of its mesh.

Every vertex asks the scanned points around it, with the weights of `neighbours`. What is measured is averaged; colours
are, in linear light. Labels have no mean: the value with the greatest weight wins, and the nearer one of two equals.
Values that are not finite do not count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.geometry.colors import as_bytes, to_linear, to_srgb
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.parallel import slices

MEASURED = ("amplitude", "confidence", "intensity", "quality", "reflectance")
"""Names of measured values, which are averaged even where a file holds whole numbers."""

FEW = 64
"""A floating-point column of at most so many different whole numbers holds labels, as text files have them."""


@dataclass(frozen=True)
class _Transfer:
    """How an attribute is carried: made ready, of shape (N, C); mixed, of shapes (V, K, C) and (V, K); turned back."""

    how: str
    ready: Callable[[Values], Values]
    mix: Callable[[Values, Float], Values]
    back: Callable[[Values], Values]


def transfer_attributes(
    vertices: Float, cloud: PointCloud, names: Sequence[str], around: Neighbourhood
) -> tuple[list[Attribute], list[str]]:
    """Return attributes of a cloud for the vertices of a mesh.

    Parameters
    ----------
    vertices : array of shape (V, 3), file units
    cloud : PointCloud
    names : sequence of str
        Which of its attributes.
    around : Neighbourhood
        Of the cloud's points.

    Returns
    -------
    list of Attribute
        ``colors`` as 8-bit sRGB, all others in the types that the cloud holds.
    list of str
        A sentence for each attribute that holds no numbers.
    """
    numeric = [name for name in names if cloud.attributes[name].dtype.kind in "biuf"]
    lost = [
        f"The points' attribute {name!r} holds no numbers, so it is not carried over."
        for name in names
        if name not in numeric
    ]
    ways = {name: _transfer(name, cloud.attributes[name]) for name in numeric}
    sources = {name: way.ready(cloud.attributes[name].reshape(len(cloud), -1)) for name, way in ways.items()}
    mixed = {name: np.empty((len(vertices), source.shape[1]), source.dtype) for name, source in sources.items()}
    for near in around.near(vertices) if ways else ():
        for name, way in ways.items():
            mixed[name][near.places] = way.mix(sources[name][near.rows], near.weights)
    return [_attribute(name, way, mixed[name], cloud.attributes[name]) for name, way in ways.items()], lost


def _attribute(name: str, way: _Transfer, mixed: Values, source: Values) -> Attribute:
    values = way.back(mixed)
    shaped = values if name == "colors" else values.reshape(len(values), *source.shape[1:])
    return Attribute(name, shaped, f"{way.how} of the {COUNT} nearest points")


def _transfer(name: str, values: Values) -> _Transfer:
    kind = values.dtype
    if name == "colors" and values.ndim == 2 and values.shape[1] in (3, 4):
        return _Transfer("weighted mean in linear light", lambda v: to_linear(as_bytes(v)), _mean, _srgb)
    if _is_label(name, values):
        return _Transfer("greatest weight", lambda v: v, _vote, lambda v: v)
    return _Transfer("weighted mean", lambda v: v.astype(np.float64), _mean, lambda v: _rounded(v, kind))


def _is_label(name: str, values: Values) -> bool:
    """Whether values are names in the guise of numbers."""
    if name.lower() in MEASURED:
        return False
    if not np.issubdtype(values.dtype, np.floating):
        return True
    finite = values[np.isfinite(values)]
    return bool((finite == np.rint(finite)).all()) and len(np.unique(finite)) <= FEW


def _mean(values: Values, weights: Float) -> Values:
    """Weighted mean over K, of shape (V, C); not a number where none of the values is finite."""
    finite = np.isfinite(values)
    counted = np.where(finite, weights[:, :, None], 0.0)
    sums, total = (counted * np.where(finite, values, 0.0)).sum(axis=1), counted.sum(axis=1)
    return np.asarray(np.divide(sums, total, out=np.full_like(sums, np.nan), where=total > 0))


def _vote(values: Values, weights: Float) -> Values:
    """Of K values the one with the greatest weight, of shape (V, C)."""
    same = values[:, :, None] == values[:, None]
    votes = np.einsum("ijkc,ik->ijc", same.astype(np.float64), weights)
    return np.take_along_axis(values, votes.argmax(axis=1)[:, None], axis=1)[:, 0]


def _srgb(light: Values) -> Values:
    return to_srgb(light.astype(np.float64))


def _rounded(values: Values, kind: np.dtype[np.generic]) -> Values:
    return values.astype(kind) if np.issubdtype(kind, np.floating) else np.rint(values.astype(np.float64)).astype(kind)


# What is known of each vertex besides its place, and how it was found.


@dataclass(frozen=True)
class Attribute:
    """Values for the vertices of a mesh.

    Parameters
    ----------
    name : str
    values : array of shape (V,) or (V, C)
    origin : str
        How they were found, for the report: no sentence, no stop.
    """

    name: str
    values: Values
    origin: str


COUNT = 8
"""Points that are averaged: about the first ring around a point of an even scan."""

_RING = 6
"""Points whose circle tells the spacing."""

_QUERIES = 20_000

BATCH = 100_000
"""Places that are asked for at once."""


# The scanned points around each vertex, with weights that fade out smoothly.
#
# Of the K + 1 nearest points at distances d_0 <= ... <= d_K, the first K count, by
#
#     w_j = (d_K^2 - d_j^2) exp(-(d_j^2 - d_0^2) / (2 h^2)),    h^2 = mean of (d_j^2 - d_0^2) / 4,
#
# divided by their sum. For a place on an evenly scanned surface h is 0.6 of the spacing of the points; far from it the
# weights depend on the directions of the points alone. The first factor lets a point lose its weight before it drops
# out of the K nearest, so that an average is continuous over space wherever no two points coincide.


@dataclass(frozen=True)
class NearestPoints:
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

    def near(self, places: Float, count: int = COUNT) -> Iterator[NearestPoints]:
        """Yield the nearest points of places, of shape (V, 3), some places at a time."""
        most = self._tree.n
        for batch in slices(len(places), BATCH):
            found = self._tree.query(places[batch] - self._centre, list(range(1, min(count + 1, most) + 1)))
            distances, rows = np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.int64)
            kept = slice(None, min(count, most))
            yield NearestPoints(batch, self._rows[rows[:, kept]].astype(np.int64), _weights(distances, count))


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
