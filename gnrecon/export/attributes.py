"""Transfers a scan's colours, labels and measured values to the vertices of its mesh.

Each vertex averages the scanned points around it, with the weights of `Neighbourhood.near`. Measured values are
averaged, and so are colours, in linear light. For labels the value with the greatest weight wins, and the nearer one of
two equals. Values that are not finite do not count. The entry is `transfer_attributes`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.export.export_parameters import ExportParameters
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.geometry.colors import as_bytes, to_linear, to_srgb
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.open_scenes import sheet_triangles
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.chunks import slices

MEASURED = ("amplitude", "confidence", "intensity", "quality", "reflectance")
"""Names of measured values, which are averaged even where a file holds whole numbers."""


@dataclass(frozen=True)
class _Transfer:
    """How an attribute is transferred: values, of shape (N, C), are prepared, averaged over K, and converted back."""

    name: str
    prepare: Callable[[Values], Values]
    average: Callable[[Values, Float], Values]
    restore: Callable[[Values], Values]


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
        f"The points' attribute {name!r} holds no numbers and was left out." for name in names if name not in numeric
    ]
    methods = {name: _transfer(name, cloud.attributes[name]) for name in numeric}
    sources = {name: method.prepare(cloud.attributes[name].reshape(len(cloud), -1)) for name, method in methods.items()}
    mixed = {name: np.empty((len(vertices), source.shape[1]), source.dtype) for name, source in sources.items()}
    for near in around.near(vertices) if methods else ():
        for name, method in methods.items():
            mixed[name][near.places] = method.average(sources[name][near.rows], near.weights)
    return [_attribute(name, method, mixed[name], cloud.attributes[name]) for name, method in methods.items()], lost


def _attribute(name: str, method: _Transfer, mixed: Values, source: Values) -> Attribute:
    count = ExportParameters.attributes.nearest_points
    values = method.restore(mixed)
    shaped = values if name == "colors" else values.reshape(len(values), *source.shape[1:])
    return Attribute(name, shaped, f"{method.name} of the {count} nearest points")


def _transfer(name: str, values: Values) -> _Transfer:
    kind = values.dtype
    if name == "colors" and values.ndim == 2 and values.shape[1] in (3, 4):
        return _Transfer("weighted mean in linear light", lambda v: to_linear(as_bytes(v)), _mean, _srgb)
    if _is_label(name, values):
        return _Transfer("greatest weight", lambda v: v, _vote, lambda v: v)
    return _Transfer("weighted mean", lambda v: v.astype(np.float64), _mean, lambda v: _rounded(v, kind))


def _is_label(name: str, values: Values, *, most_labels: int = 64) -> bool:
    """Whether numbers are labels: integers, or at most `most_labels` different whole numbers, as in text files."""
    if name.lower() in MEASURED:
        return False
    if not np.issubdtype(values.dtype, np.floating):
        return True
    finite = values[np.isfinite(values)]
    return bool((finite == np.rint(finite)).all()) and len(np.unique(finite)) <= most_labels


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


@dataclass(frozen=True)
class Attribute:
    """Per-vertex values of a mesh.

    Parameters
    ----------
    name : str
    values : array of shape (V,) or (V, C)
    origin : str
        How they were computed, for the report: not a sentence.
    """

    name: str
    values: Values
    origin: str


# The weights of the scanned points around a vertex. Of the K + 1 nearest points at distances d_0 <= ... <= d_K, the
# first K count, by
#
#     w_j = (d_K^2 - d_j^2) exp(-(d_j^2 - d_0^2) / (2 h^2)),    h^2 = mean of (d_j^2 - d_0^2) / 4,
#
# divided by their sum. For a place on an evenly scanned surface h is 0.6 of the spacing of the points; far from it the
# weights depend on the directions of the points only. The first factor makes a point's weight zero before it drops out
# of the K nearest, so that an average is continuous over space wherever no two points coincide.


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
    """A search tree over scanned points; rows that are not finite are skipped, without renumbering the others.

    Parameters
    ----------
    points : array of shape (N, 3), file units, at least one of them finite
    """

    def __init__(self, points: Float) -> None:
        self._rows: Int = np.flatnonzero(np.isfinite(points).all(axis=1))
        finite = points[self._rows]
        # Large coordinates would cancel in the squares of differences.
        self._centre = finite.mean(axis=0)
        self._tree: Any = cKDTree(finite - self._centre)

    def distances(self, places: Float) -> Float:
        """Distance to the nearest point, of shape (V,), from places of shape (V, 3); file units."""
        return np.asarray(self._tree.query(places - self._centre)[0], dtype=np.float64)

    def spacing(self, *, ring_points: int = 6, most_queries: int = 20_000) -> float:
        """Typical distance between neighbouring points, in file units; 0 for a single one.

        It is the square root of the area per point, by the circle around a point that holds its `ring_points` nearest:
        the median over at most `most_queries` evenly chosen points. On an even grid it is the grid's step.
        """
        count = min(ring_points, self._tree.n - 1)
        if not count:
            return 0.0
        some = self._tree.data[:: -(-self._tree.n // most_queries)]
        radii = self._tree.query(some, [count + 1])[0][:, 0]
        # Coincident points have no distance to their neighbours.
        distinct = radii[radii > 0]
        return float(np.sqrt(np.pi / count) * np.median(distinct)) if len(distinct) else 0.0

    def near(
        self, places: Float, count: int = ExportParameters.attributes.nearest_points, *, batch_places: int = 100_000
    ) -> Iterator[NearestPoints]:
        """Yield the `count` nearest points of places, of shape (V, 3), for at most `batch_places` at a time."""
        most = self._tree.n
        for batch in slices(len(places), batch_places):
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


def distances_between_points(
    mesh: Mesh,
    distances: Float,
    points: Float,
    normals: Float,
    reach: float,
    *,
    most_gap_reaches: float = 2.0,
    least_cosine: float = 0.25,
) -> Float:
    """Return distances to the data of a sheet, of shape (V,), to which triangles between its points belong.

    A sheet was seen from one side. From there, two points next to each other show that the surface joins them, however
    far one lies behind the other, as on the sides of raised letters.

    Parameters
    ----------
    mesh : Mesh
        With V vertices.
    distances : array of shape (V,)
        From each vertex to the nearest scanned point that supports it, in file units.
    points, normals : arrays of shape (N, 3)
        Scanned points, in file units, and their outward unit normals, nearly all on one side.
    reach : float
        Distance at which support ends, in file units.
    most_gap_reaches : float
        Longest edge of such a triangle, as it is seen; with two, no point between them is farther than the reach.
    least_cosine : float
        Of the angle between the surface and a triangle that supports it.
    """
    far = np.flatnonzero(distances > reach)
    triangles, flat = sheet_triangles(points, normals.mean(axis=0))
    edges = np.linalg.norm(flat[triangles] - flat[np.roll(triangles, 1, axis=1)], axis=2)
    triangles = triangles[edges.max(axis=1) <= most_gap_reaches * reach]
    if not len(far) or not len(triangles):
        return distances
    sheet = Mesh(points, triangles)
    gaps, faces = nearest_on_surface(sheet, mesh.vertices[far])
    facing = sheet.face_vectors[faces]
    cosines = np.einsum("gi,gi->g", facing, mesh.vertex_normals()[far]) / np.maximum(
        np.linalg.norm(facing, axis=1), np.finfo(np.float64).tiny
    )
    result = distances.copy()
    result[far] = np.where(cosines > least_cosine, np.minimum(result[far], gaps), result[far])
    return result
