"""What a mesh can be coloured by: one layer for each field of values that it carries, with its scale and its spread."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.statistics import Histogram
from gnrecon.page.numbers import figure

BINS = 56

PERCENTILE = 99.0
"""Where a scale ends: the few values beyond it would leave all others in one colour. They take the last colour."""


@dataclass(frozen=True)
class Kind:
    """How a field of values is shown.

    Parameters
    ----------
    title, meaning : str
        For the reader.
    power : int or None
        Of the file's unit of length that the values are in; None where it is not known.
    ramp : str
        A name of `ramps.STOPS`.
    signed : bool
        Whether zero is the middle of the scale.
    """

    title: str
    meaning: str
    power: int | None
    ramp: str
    signed: bool = False


KINDS = {
    "error": Kind(
        "Error",
        "Signed distance to the reference: positive where the mesh lies outside of it.",
        1,
        "diverging",
        signed=True,
    ),
    "sigma": Kind(
        "Uncertainty",
        "Standard deviation of the position along the normal, as the fit itself sees it.",
        1,
        "uncertainty",
    ),
    "distance": Kind("Distance to data", "From the surface to the nearest scanned point.", 1, "distance"),
    "mean_curvature": Kind("Mean curvature", "Mean of the two principal curvatures.", -1, "curvature", signed=True),
    "gauss_curvature": Kind(
        "Gaussian curvature", "Product of the two principal curvatures.", -2, "curvature", signed=True
    ),
}
"""The fields that gnrecon itself makes; whatever else a mesh carries is shown under its own name."""

UNITS = {1: "file units", -1: "1 / file unit", -2: "1 / file unit²", None: ""}


@dataclass(frozen=True)
class Layer:
    """A field of values on a mesh, ready to be drawn.

    Parameters
    ----------
    name : str
        Of the mesh's attribute.
    kind : Kind
    values : array of shape (V,)
    low, high : float
        Ends of the scale.
    histogram : Histogram
        Of the surface's area over the values, from `low` to `high`.
    figures : tuple of pairs of str
        What is worth saying in numbers, each with its label.
    beyond : float, optional
        Value from which on the surface is hatched.
    """

    name: str
    kind: Kind
    values: Float
    low: float
    high: float
    histogram: Histogram
    figures: tuple[tuple[str, str], ...]
    beyond: float | None = None

    @property
    def unit(self) -> str:
        """Unit of the values, in words."""
        return UNITS[self.kind.power]


def layers(
    mesh: Mesh, origins: Mapping[str, str] = MappingProxyType({}), beyond: Mapping[str, float] = MappingProxyType({})
) -> list[Layer]:
    """Return a layer for every scalar attribute of the mesh that has a finite value, gnrecon's own first.

    Parameters
    ----------
    mesh : Mesh
    origins : mapping of str to str
        How the values of an attribute were found, for those that are none of `KINDS`.
    beyond : mapping of str to float
        Values of an attribute from which on the surface is hatched.
    """
    scalars = {
        name: np.asarray(values, dtype=np.float64)
        for name, values in mesh.attributes.items()
        if values.ndim == 1 and np.issubdtype(values.dtype, np.number) and np.isfinite(values).any()
    }
    order = [*(name for name in KINDS if name in scalars), *(name for name in scalars if name not in KINDS)]
    areas = vertex_areas(mesh)
    return [replace(_layer(name, scalars[name], areas, origins), beyond=beyond.get(name)) for name in order]


def vertex_areas(mesh: Mesh) -> Float:
    """Return a third of the area of the faces around each vertex, of shape (V,)."""
    thirds = np.linalg.norm(mesh.face_vectors, axis=1) / 3
    areas: Float = np.bincount(mesh.faces.reshape(-1), thirds.repeat(3), len(mesh.vertices)).astype(np.float64)
    return areas


def _layer(name: str, values: Float, areas: Float, origins: Mapping[str, str]) -> Layer:
    origin = origins.get(name, "carried by the mesh")
    kind = KINDS.get(name) or Kind(_sentence(name.replace("_", " ")), f"{_sentence(origin)}.", None, "plain")
    finite = np.isfinite(values)
    low, high = _scale(values[finite], kind)
    histogram = Histogram.of(values[finite], low, high, BINS, areas[finite])
    return Layer(name, kind, values, low, high, histogram, _figures(values[finite], areas[finite], kind))


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:]


def _scale(values: Float, kind: Kind) -> tuple[float, float]:
    """Ends of the scale for finite values of shape (N,): never equal."""
    if kind.signed:
        reach = float(np.percentile(np.abs(values), PERCENTILE)) or 1.0
        return -reach, reach
    low, high = (float(end) for end in np.percentile(values, [100 - PERCENTILE, PERCENTILE]))
    if kind.power is not None:
        low = 0.0
    return (low, high) if high > low else (low, low + (abs(low) or 1.0))


def _figures(values: Float, areas: Float, kind: Kind) -> tuple[tuple[str, str], ...]:
    sizes = np.abs(values) if kind.signed else values
    mean = float(np.average(sizes, weights=areas)) if areas.sum() > 0 else float(sizes.mean())
    figures = [
        ("mean size" if kind.signed else "mean", mean),
        ("95 % within ±" if kind.signed else "95 % below", float(np.percentile(sizes, 95))),
        ("largest", float(sizes.max())),
    ]
    return tuple((label, figure(value)) for label, value in figures)
