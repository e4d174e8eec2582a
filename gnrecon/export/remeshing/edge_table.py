"""The data structure of remeshing: a closed surface with normals and creases, and the table of its edges.

Creases are edges where the surface is sharp. They are kept as pairs of vertices and follow every split and collapse, so
that they need not be detected again on a coarser mesh, where a bend of the surface looks like an edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh


class VertexKind(IntEnum):
    """Kinds of vertices: without a crease, on one that passes through, and where creases end, meet or branch."""

    SMOOTH = 0
    CREASE = 1
    CORNER = 2


@dataclass(frozen=True)
class CreasedSurface:
    """A closed, oriented 2-manifold with creases.

    Parameters
    ----------
    vertices : array of shape (V, 3)
    normals : array of shape (V, 3)
        The field's unit normals; on creases they are those of any side.
    faces : integer array of shape (F, 3)
    creases : integer array of shape (C, 2)
        Edges, each with its lower vertex first, in no order.
    """

    vertices: Float
    normals: Float
    faces: Int
    creases: Int

    def kinds(self) -> Int:
        """The `VertexKind` of each vertex, of shape (V,)."""
        count = np.bincount(self.creases.reshape(-1), minlength=len(self.vertices))
        on_crease = np.where(count == 2, VertexKind.CREASE, VertexKind.CORNER)
        return np.where(count == 0, VertexKind.SMOOTH, on_crease).astype(np.int64)

    def mesh(self) -> Mesh:
        """Return vertices and faces as a mesh without normals."""
        return Mesh(self.vertices, self.faces)

    def compact(self) -> CreasedSurface:
        """Return the surface without vertices that no face uses, the others in their order."""
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.faces] = True
        names = np.cumsum(used) - 1
        return CreasedSurface(self.vertices[used], self.normals[used], names[self.faces], names[self.creases])

    def is_crease(self, ends: Int) -> Mask:
        """Which edges, of shape (E, 2) with the lower vertex first, are creases; of shape (E,)."""
        size = len(self.vertices)
        return np.isin(ends[:, 0] * size + ends[:, 1], self.creases[:, 0] * size + self.creases[:, 1])


@dataclass(frozen=True)
class EdgeTable:
    """The edges of a closed, oriented 2-manifold, sorted by their vertices.

    Parameters
    ----------
    ends : integer array of shape (E, 2)
        Vertices, the lower one first.
    faces : integer array of shape (E, 2)
        The face that walks from the lower to the higher vertex, and the one that walks back.
    opposite : integer array of shape (E, 2)
        The third vertex of each of these faces.
    half_edges : integer array of shape (E, 2)
        ``3 face + k`` of the corner that each of these faces walks the edge from.
    """

    ends: Int
    faces: Int
    opposite: Int
    half_edges: Int

    @classmethod
    def of(cls, faces: Int) -> EdgeTable:
        """List the edges of `faces`, of shape (F, 3)."""
        start = faces.reshape(-1)
        end = np.roll(faces, -1, axis=1).reshape(-1)
        low, high = np.minimum(start, end), np.maximum(start, end)
        # Each edge appears once each way; the way up comes first.
        order = np.argsort(2 * (low * (int(faces.max(initial=0)) + 1) + high) + (start > end), kind="stable")
        pairs = order.reshape(-1, 2)
        opposite = np.roll(faces, -2, axis=1).reshape(-1)
        return cls(np.stack([low, high], axis=1)[pairs[:, 0]], pairs // 3, opposite[pairs], pairs)


def area_vectors(vertices: Float, faces: Int) -> Float:
    """Normals of faces, of shape (F, 3), as long as the areas."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def unit(vectors: Float) -> Float:
    """Vectors of shape (N, 3) at length one; zeros stay zeros."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    units: Float = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
    return units


def face_normals(surface: CreasedSurface) -> Float:
    """Unit normals that the faces should have, of shape (F, 3): the mean of the field's at their smooth vertices.

    They are right also where a face is a sliver or turned over, and on either side of a crease. A face whose vertices
    all lie on creases gets its own.
    """
    smooth = surface.normals * (surface.kinds() == VertexKind.SMOOTH)[:, None]
    sums = smooth[surface.faces].sum(axis=1)
    unknown = np.einsum("ij,ij->i", sums, sums) < 0.01
    sums[unknown] = area_vectors(surface.vertices, surface.faces[unknown])
    return unit(sums)


# Independent sets of local changes, which can all be applied at once. Every candidate has a rank and a set of vertices.
# It is chosen when it has the lowest rank of all candidates on each of its vertices. So chosen candidates share no
# vertex, and since the lowest rank of all is always chosen, rounds end.


def ranks(order_by: Float) -> Int:
    """Ranks from 0 of values of shape (N,), ties in their order."""
    rank = np.empty(len(order_by), dtype=np.int64)
    rank[np.argsort(order_by, kind="stable")] = np.arange(len(order_by))
    return rank


def independent_set(members: Int, rank: Int, count: int) -> Mask:
    """Which candidates, with vertices `members` of shape (N, K) among `count`, share no vertex with a lower rank."""
    best = np.full(count, len(rank), dtype=np.int64)
    for column in members.T:
        np.minimum.at(best, column, rank)
    chosen: Mask = (best[members] == rank[:, None]).all(axis=1)
    return chosen


def independent_rings(members: Int, rank: Int, faces: Int, count: int) -> Mask:
    """Which candidates, with vertices `members` of shape (N, K), touch no face that one of lower rank touches."""
    best = np.full(count, len(rank), dtype=np.int64)
    for column in members.T:
        np.minimum.at(best, column, rank)
    around = best[faces].min(axis=1)
    seen = np.full(count, len(rank), dtype=np.int64)
    for corner in faces.T:
        np.minimum.at(seen, corner, around)
    chosen: Mask = (seen[members] == rank[:, None]).all(axis=1)
    return chosen
