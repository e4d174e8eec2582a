"""How well shaped a mesh's faces are: edge lengths and angles."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

BIN = 5.0
"""Width of the histogram's bins, in degrees."""


@dataclass(frozen=True)
class MeshQuality:
    """Edge lengths and angles of a mesh's faces.

    Parameters
    ----------
    edge_length : dict
        ``mean``, ``min``, ``max`` and ``std`` over the edges, each counted once, in units of the vertices.
    angle_degrees : dict
        ``min``, ``p1``, ``p5``, ``median``, ``p95``, ``p99`` and ``max`` over the corners of all faces; ``p1`` is the
        first percentile. Equilateral faces have 60 throughout.
    histogram : dict
        ``edges``, of shape (37,), in degrees, and ``counts``, of shape (36,), of the corners' angles.
    """

    edge_length: dict[str, float]
    angle_degrees: dict[str, float]
    histogram: dict[str, list[float] | list[int]]

    def as_dict(self) -> dict[str, object]:
        """All figures by name, ready for JSON."""
        return asdict(self)


def quality(mesh: Mesh) -> MeshQuality:
    """Measure the edges and angles of a mesh with at least one face."""
    lengths, angles = edge_lengths(mesh), corner_angles(mesh).reshape(-1)
    percentiles = {"min": 0, "p1": 1, "p5": 5, "median": 50, "p95": 95, "p99": 99, "max": 100}
    values = np.percentile(angles, list(percentiles.values()))
    bins = np.arange(0.0, 180.0 + BIN, BIN)
    figures = {"mean": lengths.mean(), "min": lengths.min(), "max": lengths.max(), "std": lengths.std()}
    return MeshQuality(
        edge_length={name: float(value) for name, value in figures.items()},
        angle_degrees={name: float(value) for name, value in zip(percentiles, values, strict=True)},
        histogram={"edges": bins.tolist(), "counts": np.histogram(angles, bins)[0].tolist()},
    )


def edge_lengths(mesh: Mesh) -> Float:
    """Return the length of each edge once, of shape (E,), in the mesh's units."""
    ends = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    # One number an edge sorts many times faster than a pair.
    once = np.unique(ends[:, 0] * len(mesh.vertices) + ends[:, 1])
    start, end = np.divmod(once, len(mesh.vertices))
    lengths: Float = np.linalg.norm(mesh.vertices[end] - mesh.vertices[start], axis=1)
    return lengths


def corner_angles(mesh: Mesh) -> Float:
    """Return the angle at each corner of each face, of shape (F, 3), in degrees; zero where an edge has no length."""
    corners = mesh.corners
    ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    # The tangent's two parts stay exact for needles, where the cosine alone would not.
    sines = np.linalg.norm(np.cross(ahead, behind), axis=2)
    angles: Float = np.degrees(np.arctan2(sines, np.einsum("fki,fki->fk", ahead, behind)))
    return angles
