"""Connectivity of a mesh (edges, vertex fans, components) and the quality of its faces (edge lengths, angles).

A face (a, b, c) walks the half-edges a -> b, b -> c and c -> a. In a closed, oriented surface every edge is walked
exactly twice, once each way. Around a vertex of a 2-manifold the faces form a single fan: linking the corners of
faces that share an edge there leaves one group of corners for each vertex.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh


@dataclass(frozen=True)
class Edges:
    """Half-edges of a mesh, sorted so that those of one edge follow each other.

    Parameters
    ----------
    ends : integer array of shape (3 F, 2)
        Lower and higher vertex of each half-edge.
    forward : boolean array of shape (3 F,)
        Whether the face walks from the lower to the higher vertex.
    corner : integer array of shape (3 F,)
        Index ``3 face + k`` of the corner that the half-edge starts from.
    first : integer array of shape (E,)
        Where each edge's half-edges begin.
    count : integer array of shape (E,)
        How many half-edges each edge has.
    """

    ends: Int
    forward: Mask
    corner: Int
    first: Int
    count: Int

    @classmethod
    def of(cls, mesh: Mesh) -> Edges:
        """Sort the half-edges of `mesh`."""
        start = mesh.faces.reshape(-1)
        end = np.roll(mesh.faces, -1, axis=1).reshape(-1)
        low, high = np.minimum(start, end), np.maximum(start, end)
        key = low * max(len(mesh.vertices), 1) + high
        order = np.argsort(key, kind="stable")
        _, first, count = np.unique(key[order], return_index=True, return_counts=True)
        ends = np.stack([low[order], high[order]], axis=1)
        return cls(ends, (start < end)[order], order.astype(np.int64), first.astype(np.int64), count.astype(np.int64))

    def balanced(self) -> Mask:
        """Which edges are walked as often one way as the other, of shape (E,)."""
        sums = np.add.reduceat(np.where(self.forward, 1, -1), self.first) if len(self.first) else np.empty(0)
        return np.asarray(sums == 0)


def split_vertices(mesh: Mesh, edges: Edges) -> Int:
    """Vertices, of shape (N,), whose faces form more than one fan.

    Edges with other than two half-edges link nothing, so that the result is right for closed meshes only.
    """
    fans = corner_fans(mesh, edges)
    # A pair as one number is sorted many times as fast as a row of two.
    pairs = np.unique(mesh.faces.reshape(-1) * max(len(fans), 1) + fans)
    vertices, count = np.unique(pairs // max(len(fans), 1), return_counts=True)
    return np.asarray(vertices[count > 1], dtype=np.int64)


def corner_fans(mesh: Mesh, edges: Edges) -> Int:
    """Label of the fan that each corner belongs to, of shape (3 F,)."""
    size = mesh.faces.size
    first = edges.first[edges.count == 2]
    one, other = edges.corner[first], edges.corner[first + 1]
    # A half-edge's start corner and the next corner of its face are the two places where fans meet along the edge.
    one_end, other_end = one - one % 3 + (one + 1) % 3, other - other % 3 + (other + 1) % 3
    vertex = mesh.faces.reshape(-1)
    opposite = vertex[one] == vertex[other_end]
    rows = np.concatenate([one, one_end])
    columns = np.concatenate([np.where(opposite, other_end, other), np.where(opposite, other, other_end)])
    links = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(size, size))
    labels: Int = connected_components(links, directed=False)[1].astype(np.int64)
    return labels


def face_components(mesh: Mesh) -> Int:
    """Label from 0 of the component that each face belongs to, of shape (F,); faces that share a vertex are joined."""
    start, end = mesh.faces[:, [0, 1]].reshape(-1), mesh.faces[:, [1, 2]].reshape(-1)
    size = len(mesh.vertices)
    links = coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(size, size))
    labels = connected_components(links, directed=False)[1][mesh.faces[:, 0]]
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def submesh(mesh: Mesh, faces: Mask) -> Mesh:
    """The mesh of the given faces, a mask of shape (F,), with the vertices that they use and their normals."""
    used, inverse = np.unique(mesh.faces[faces], return_inverse=True)
    normals = None if mesh.normals is None else mesh.normals[used]
    return Mesh(mesh.vertices[used], inverse.reshape(-1, 3), normals)


def concatenated(parts: Sequence[Mesh]) -> Mesh:
    """The mesh of the faces of all parts, of which there is at least one; with normals where all parts have them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    normals = [part.normals for part in parts if part.normals is not None]
    whole = np.concatenate(normals) if len(normals) == len(parts) else None
    return Mesh(np.concatenate([part.vertices for part in parts]), faces, whole)


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


def quality(mesh: Mesh, *, bin_degrees: float = 5.0) -> MeshQuality:
    """Measure the edges and angles of a mesh with at least one face; `bin_degrees` is the histogram's bin width."""
    lengths, angles = edge_lengths(mesh), corner_angles(mesh).reshape(-1)
    percentiles = {"min": 0, "p1": 1, "p5": 5, "median": 50, "p95": 95, "p99": 99, "max": 100}
    values = np.percentile(angles, list(percentiles.values()))
    bins = np.arange(0.0, 180.0 + bin_degrees, bin_degrees)
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
