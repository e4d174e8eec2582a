"""Carry a scan's colours, labels and measured values over to the vertices of its mesh.

Every vertex asks the scanned points around it, with the weights of `neighbours`. What is measured is averaged; colours
are, in linear light. Labels have no mean: the value with the greatest weight wins, and the nearer one of two equals.
Values that are not finite do not count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gnrecon.export.attribute import Attribute
from gnrecon.export.neighbours import COUNT, Neighbourhood
from gnrecon.geometry.arrays import Float, Values
from gnrecon.geometry.colors import as_bytes, to_linear, to_srgb
from gnrecon.geometry.point_cloud import PointCloud

MEASURED = ("amplitude", "confidence", "intensity", "quality", "reflectance")
"""Names of measured values, which are averaged even where a file holds whole numbers."""

FEW = 64
"""A floating-point column of at most so many different whole numbers holds labels, as text files have them."""


@dataclass(frozen=True)
class _Way:
    """How an attribute is carried: made ready, of shape (N, C); mixed, of shapes (V, K, C) and (V, K); turned back."""

    how: str
    ready: Callable[[Values], Values]
    mix: Callable[[Values, Float], Values]
    back: Callable[[Values], Values]


def carry(
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
    ways = {name: _way(name, cloud.attributes[name]) for name in numeric}
    sources = {name: way.ready(cloud.attributes[name].reshape(len(cloud), -1)) for name, way in ways.items()}
    mixed = {name: np.empty((len(vertices), source.shape[1]), source.dtype) for name, source in sources.items()}
    for near in around.near(vertices) if ways else ():
        for name, way in ways.items():
            mixed[name][near.places] = way.mix(sources[name][near.rows], near.weights)
    return [_attribute(name, way, mixed[name], cloud.attributes[name]) for name, way in ways.items()], lost


def _attribute(name: str, way: _Way, mixed: Values, source: Values) -> Attribute:
    values = way.back(mixed)
    shaped = values if name == "colors" else values.reshape(len(values), *source.shape[1:])
    return Attribute(name, shaped, f"{way.how} of the {COUNT} nearest points")


def _way(name: str, values: Values) -> _Way:
    kind = values.dtype
    if name == "colors" and values.ndim == 2 and values.shape[1] in (3, 4):
        return _Way("weighted mean in linear light", lambda v: to_linear(as_bytes(v)), _mean, _srgb)
    if _is_label(name, values):
        return _Way("greatest weight", lambda v: v, _vote, lambda v: v)
    return _Way("weighted mean", lambda v: v.astype(np.float64), _mean, lambda v: _rounded(v, kind))


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
