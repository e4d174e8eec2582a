"""What the page's viewer is given: the surface, the points and the layers, as compressed arrays in text.

Positions are relative to the middle of the mesh's box and in units of its radius, so that single precision suffices
wherever the file's coordinates lie; numbers that the viewer shows are turned back in double precision.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.export import lighten, vertex_sky
from gnrecon.geometry.arrays import Float, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.page.layers import Layer
from gnrecon.page.ramps import ramp

MOST_FACES, MOST_POINTS = 300_000, 100_000
"""What a browser turns smoothly, and what a page can hold without becoming slow to open."""

NO_VALUE = -3e38
"""Stands for a value that is not finite: single precision has it, and no layer reaches so far."""


@dataclass(frozen=True)
class Model:
    """The viewer's data.

    Parameters
    ----------
    buffers : dict of str
        Arrays by name, each little-endian, compressed by zlib, in base64.
    scene : dict
        All that is no array: the place and the size of the model, its layers and counts, ready for JSON.
    """

    buffers: dict[str, str]
    scene: dict[str, Any]


def model(mesh: Mesh, cloud: PointCloud | None, shown: Sequence[Layer], solid: bool) -> Model:
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
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 or 1.0
    light = lighten(Mesh(mesh.vertices, mesh.faces, mesh.normals, _attributes(mesh, shown)), MOST_FACES)
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
        scene["points"] = _add_points(buffers, cloud, centre, radius)
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
    """Normals and the share of the sky that is seen, of shape (V, 4), as normalised 16-bit numbers."""
    shape = np.concatenate([mesh.vertex_normals(), vertex_sky(mesh)[:, None]], axis=1)
    numbers: npt.NDArray[np.int16] = np.round(np.clip(shape, -1, 1) * 32767).astype("<i2")
    return numbers


def _values(values: Values) -> npt.NDArray[np.float32]:
    numbers = values.astype(np.float64)
    single: npt.NDArray[np.float32] = np.where(np.isfinite(numbers), np.clip(numbers, -1e38, 1e38), NO_VALUE).astype(
        "<f4"
    )
    return single


def _rgba(colors: Values) -> npt.NDArray[np.uint8]:
    """8-bit colours of shape (N, 4), because graphics cards want rows of four bytes."""
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


def _add_points(buffers: dict[str, str], cloud: PointCloud, centre: Float, radius: float) -> dict[str, Any]:
    """Pack some of the points; return what there is to say of them."""
    from scipy.spatial import cKDTree

    finite = np.flatnonzero(np.isfinite(cloud.points).all(axis=1))
    if len(finite) > MOST_POINTS:
        finite = np.sort(np.random.default_rng(0).choice(finite, MOST_POINTS, replace=False))
    points = (cloud.points[finite] - centre) / radius
    buffers["points"] = pack(points.astype("<f4"))
    if cloud.normals is not None:
        lengths = np.maximum(np.linalg.norm(cloud.normals[finite], axis=1, keepdims=True), 1e-300)
        normals = np.zeros((len(finite), 4))
        normals[:, :3] = np.nan_to_num(cloud.normals[finite] / lengths)
        buffers["point-normals"] = pack(np.round(np.clip(normals, -1, 1) * 127).astype(np.int8))
    if "colors" in cloud.attributes:
        buffers["point-colors"] = pack(_rgba(cloud.attributes["colors"][finite]))
    some = points[:: -(-len(points) // 2000)]
    spacing = float(np.median(cKDTree(points).query(some, k=2)[0][:, 1])) if len(points) > 1 else 0.02
    return {"shown": len(finite), "all": len(cloud), "spacing": spacing}
