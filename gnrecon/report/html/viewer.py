"""Packs the surface, the points and the layers for the page's viewer, as compressed arrays in text.

Positions are relative to the centre of the mesh's box and in units of its radius, so that single precision suffices for
any coordinates; the viewer converts numbers that it shows back in double precision.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.export import decimate_by_clustering
from gnrecon.geometry.arrays import Float, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.geometry.statistics import Histogram
from gnrecon.rendering import vertex_ambient_occlusion
from gnrecon.report.html.scales import figure, ramp


@dataclass(frozen=True)
class Model:
    """The viewer's data.

    Parameters
    ----------
    buffers : dict of str
        Arrays by name, each little-endian, compressed by zlib, in base64.
    scene : dict
        Position and size of the model, its layers and counts, ready for JSON.
    """

    buffers: dict[str, str]
    scene: dict[str, Any]


def model(
    mesh: Mesh,
    cloud: PointCloud | None,
    shown: Sequence[Layer],
    solid: bool,
    *,
    most_faces: int = 300_000,
    most_points: int = 100_000,
) -> Model:
    """Pack a mesh and its scan for the viewer.

    Parameters
    ----------
    mesh : Mesh
        With at least one face; its ``colors`` are shown, if it has any.
    cloud : PointCloud, optional
    shown : sequence of Layer
        Of the same mesh.
    solid : bool
        Whether the mesh bounds a solid, so that a section through it is filled.
    most_faces, most_points : int
        Limits of what is shown: browsers turn so much smoothly, and the page opens quickly.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 or 1.0
    light = decimate_by_clustering(Mesh(mesh.vertices, mesh.faces, mesh.normals, _attributes(mesh, shown)), most_faces)
    buffers = {
        "positions": pack(((light.vertices - centre) / radius).astype("<f4")),
        "shape": pack(_shape(light)),
        "faces": pack(light.faces.astype("<u4")),
    }
    buffers |= {f"layer-{index}": pack(_values(light.attributes[layer.name])) for index, layer in enumerate(shown)}
    buffers |= {f"ramp-{name}": pack(ramp(name)) for name in {layer.kind.ramp: None for layer in shown}}
    if "colors" in light.attributes:
        buffers["colors"] = pack(_rgba(light.attributes["colors"]))
    scene: dict[str, Any] = {
        "centre": centre.tolist(),
        "radius": radius,
        "low": low.tolist(),
        "high": high.tolist(),
        "solid": solid,
        "layers": [_described(layer) for layer in shown],
        "faces": len(light.faces),
        "all_faces": len(mesh.faces),
        "points": None,
    }
    if cloud is not None and np.isfinite(cloud.points).all(axis=1).any():
        scene["points"] = _add_points(buffers, cloud, centre, radius, most_points)
    return Model(buffers, scene)


def pack(values: Values) -> str:
    """Return an array's bytes, compressed by zlib, in base64."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 6)).decode("ascii")


def _attributes(mesh: Mesh, shown: Sequence[Layer]) -> dict[str, Values]:
    kept: dict[str, Values] = {layer.name: layer.values for layer in shown}
    if "colors" in mesh.attributes:
        kept["colors"] = mesh.attributes["colors"]
    return kept


def _shape(mesh: Mesh) -> npt.NDArray[np.int16]:
    """Normals and ambient occlusion, of shape (V, 4), as normalised 16-bit numbers."""
    shape = np.concatenate([mesh.vertex_normals(), vertex_ambient_occlusion(mesh)[:, None]], axis=1)
    numbers: npt.NDArray[np.int16] = np.round(np.clip(shape, -1, 1) * 32767).astype("<i2")
    return numbers


def _values(values: Values) -> npt.NDArray[np.float32]:
    """Values in single precision; -3e38, which the viewer knows and no layer reaches, where they are not finite."""
    numbers = values.astype(np.float64)
    shown = np.where(np.isfinite(numbers), np.clip(numbers, -1e38, 1e38), -3e38)
    single: npt.NDArray[np.float32] = shown.astype("<f4")
    return single


def _rgba(colors: Values) -> npt.NDArray[np.uint8]:
    """8-bit colours of shape (N, 4), because WebGL aligns rows to four bytes."""
    rgba = np.full((len(colors), 4), 255, dtype=np.uint8)
    rgba[:, :3] = as_bytes(colors)[:, :3]
    return rgba


def _described(layer: Layer) -> dict[str, Any]:
    return {
        "name": layer.name,
        "title": layer.kind.title,
        "unit": layer.unit,
        "ramp": layer.kind.ramp,
        "low": layer.low,
        "high": layer.high,
        "beyond": layer.beyond,
    }


def _add_points(buffers: dict[str, str], cloud: PointCloud, centre: Float, radius: float, most: int) -> dict[str, Any]:
    """Pack at most so many of the points; return their counts and spacing."""
    from scipy.spatial import cKDTree

    finite = np.flatnonzero(np.isfinite(cloud.points).all(axis=1))
    if len(finite) > most:
        finite = np.sort(np.random.default_rng(0).choice(finite, most, replace=False))
    points = (cloud.points[finite] - centre) / radius
    buffers["points"] = pack(points.astype("<f4"))
    if cloud.normals is not None and cloud.has_directions:
        lengths = np.maximum(np.linalg.norm(cloud.normals[finite], axis=1, keepdims=True), 1e-300)
        normals = np.zeros((len(finite), 4))
        normals[:, :3] = np.nan_to_num(cloud.normals[finite] / lengths)
        buffers["point-normals"] = pack(np.round(np.clip(normals, -1, 1) * 127).astype(np.int8))
    if "colors" in cloud.attributes:
        buffers["point-colors"] = pack(_rgba(cloud.attributes["colors"][finite]))
    some = points[:: -(-len(points) // 2000)]
    spacing = float(np.median(cKDTree(points).query(some, k=2)[0][:, 1])) if len(points) > 1 else 0.02
    return {"shown": len(finite), "all": len(cloud), "spacing": spacing}


@dataclass(frozen=True)
class Kind:
    """How a field of values is shown.

    Parameters
    ----------
    title, meaning : str
        For the reader.
    power : int or None
        Of the file's unit of length in the values' unit; None where it is not known.
    ramp : str
        A name of `gnrecon.report.html.scales.STOPS`.
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
        "Standard deviation of the position along the normal, estimated by the fit.",
        1,
        "uncertainty",
    ),
    "distance": Kind("Distance to data", "From the surface to the nearest scanned point.", 1, "distance"),
    "mean_curvature": Kind("Mean curvature", "Mean of the two principal curvatures.", -1, "curvature", signed=True),
    "gauss_curvature": Kind(
        "Gaussian curvature", "Product of the two principal curvatures.", -2, "curvature", signed=True
    ),
}
"""Attributes that gnrecon computes; others are shown under their own names."""


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
        Statistics, each with its label.
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
        return {1: "file units", -1: "1 / file unit", -2: "1 / file unit²", None: ""}[self.kind.power]


def layers(
    mesh: Mesh, origins: Mapping[str, str] = MappingProxyType({}), beyond: Mapping[str, float] = MappingProxyType({})
) -> list[Layer]:
    """Return a layer for every scalar attribute of the mesh that has a finite value, gnrecon's own first.

    Values beyond single precision, in which the page has them, count as missing.

    Parameters
    ----------
    mesh : Mesh
    origins : mapping of str to str
        How the values of an attribute were found, for attributes that are not in `KINDS`.
    beyond : mapping of str to float
        Values of an attribute from which on the surface is hatched.
    """
    scalars = {
        name: np.where(np.abs(values) < 1e38, values, np.nan)
        for name, values in mesh.attributes.items()
        if values.ndim == 1 and np.issubdtype(values.dtype, np.number)
    }
    scalars = {name: values for name, values in scalars.items() if np.isfinite(values).any()}
    order = [*(name for name in KINDS if name in scalars), *(name for name in scalars if name not in KINDS)]
    areas = vertex_areas(mesh)
    return [replace(_layer(name, scalars[name], areas, origins), beyond=beyond.get(name)) for name in order]


def vertex_areas(mesh: Mesh) -> Float:
    """Return a third of the area of the faces around each vertex, of shape (V,)."""
    thirds = np.linalg.norm(mesh.face_vectors, axis=1) / 3
    areas: Float = np.bincount(mesh.faces.reshape(-1), thirds.repeat(3), len(mesh.vertices)).astype(np.float64)
    return areas


def _layer(name: str, values: Float, areas: Float, origins: Mapping[str, str], *, bins: int = 56) -> Layer:
    origin = origins.get(name, "carried by the mesh")
    kind = KINDS.get(name) or Kind(_sentence(name.replace("_", " ")), f"{_sentence(origin)}.", None, "plain")
    finite = np.isfinite(values)
    low, high = _scale(values[finite], kind)
    histogram = Histogram.of(values[finite], low, high, bins, areas[finite])
    return Layer(name, kind, values, low, high, histogram, _figures(values[finite], areas[finite], kind))


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:]


def _scale(values: Float, kind: Kind, *, end_percentile: float = 99.0) -> tuple[float, float]:
    """Ends of the scale for finite values of shape (N,): never equal.

    The scale ends at a percentile, because a few extreme values would leave all others in one colour; values beyond it
    get the last colour.
    """
    if kind.signed:
        reach = float(np.percentile(np.abs(values), end_percentile)) or 1.0
        return -reach, reach
    low, high = (float(end) for end in np.percentile(values, [100 - end_percentile, end_percentile]))
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
