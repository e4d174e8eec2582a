"""Give back the edges and corners that marching cubes cuts off.

Marching cubes puts vertices on the edges of a lattice only, and so bridges a sharp edge of the surface by chamfers. A
chamfer shows in the field: its ends lie on different sides, so that the normals there differ. Each such mesh edge is
split at the point where the two sides meet, and a face with all three ends on different sides also gets the corner
where they meet: the edge sharpener of Attene, Falcidieno, Rossignac and Spagnuolo (2005), with the field's own planes
in place of estimated ones. Splitting leaves a closed 2-manifold closed and manifold.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.crease import meeting_points
from gnrecon.export.protocol import SignedDistance
from gnrecon.export.split import split
from gnrecon.export.surface import EdgeTable, Surface, area_vectors, unit
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh

REACH = 1.5
"""How far from a chamfer's middle its crease may lie, in lengths of the chamfer."""

BETTER = 0.5
"""A new point counts when the field is nearer to zero there than in the chamfer's middle, by this factor."""


def sharpen(mesh: Mesh, field: SignedDistance, *, angle: float = 30.0) -> Mesh:
    """Split chamfers where the field has an edge.

    Parameters
    ----------
    mesh : Mesh
        Closed and manifold, as `extract` and `project` return it, in file units.
    field : SignedDistance
        The field that it was extracted from.
    angle : float
        Degrees by which the normals at the ends of a chamfer differ at least.

    Returns
    -------
    Mesh
        The old vertices where they were, followed by the new ones, without normals; the mesh itself where the field has
        no edge.
    """
    edges = EdgeTable.of(mesh.faces)
    normals = unit(field.gradient(mesh.vertices))
    ends = normals[edges.ends]
    rows = np.flatnonzero(np.einsum("ij,ij->i", ends[:, 0], ends[:, 1]) < np.cos(np.radians(angle)))
    crossings = _crossings(mesh.vertices[edges.ends[rows]], ends[rows])
    points, better = _crease_points(mesh, edges.ends[rows], crossings, field, angle)
    marked = np.zeros(len(edges.ends), dtype=bool)
    marked[rows[better]] = True
    if not marked.any():
        return mesh
    sides = np.bincount(edges.faces[marked].reshape(-1), minlength=len(mesh.faces))
    full = mesh.faces[sides == 3]
    middles = mesh.vertices[full].mean(axis=1)
    centres, at_corner = _crease_points(mesh, full, middles, field, angle)
    surface = Surface(mesh.vertices, normals, mesh.faces, np.empty((0, 2), dtype=np.int64))
    plain = np.concatenate([mesh.vertices, mesh.vertices[edges.ends[marked]].mean(axis=1), middles])
    result = split(surface, edges, marked, points[better], np.where(at_corner[:, None], centres, middles))
    return Mesh(_unfolded(result, plain, len(normals)), result.faces)


def _unfolded(surface: Surface, plain: Float, old: int) -> Float:
    """Vertices, of shape (V, 3), with those in their `plain` places that would fold a face over.

    Near corners a chamfer's two sides may meet beyond the third. In plain places, in the middle of what was split, no
    face is folded.
    """
    normals = surface.normals.copy()
    normals[old:] = 0
    should = normals[surface.faces].sum(axis=1)
    vertices = surface.vertices.copy()
    while True:
        folded = np.einsum("ij,ij->i", area_vectors(vertices, surface.faces), should) < 0
        back = np.unique(surface.faces[folded])
        back = back[(back >= old) & (vertices[back] != plain[back]).any(axis=1)]
        if not len(back):
            return vertices
        vertices[back] = plain[back]


def _crossings(places: Float, normals: Float) -> Float:
    """Where the straight ways between the ends of edges, of shape (N, 2, 3), cross the crease, of shape (N, 3).

    On the two planes unfolded, straight ways from one vertex to others cross the crease in the order of their ends, so
    that the pieces of faces that are split there do not fold over. The distance of an end to the other end's plane is
    proportional to its distance to the crease.
    """
    way = places[:, 1] - places[:, 0]
    distances = np.abs(np.einsum("nki,ni->nk", normals, way))[:, ::-1]
    total = distances.sum(axis=1)
    share = np.divide(distances[:, 0], total, out=np.full(len(way), 0.5), where=total > 0)
    crossings: Float = places[:, 0] + share[:, None] * way
    return crossings


def _crease_points(mesh: Mesh, corners: Int, starts: Float, field: SignedDistance, angle: float) -> tuple[Float, Mask]:
    """Where the sides meet on which the corners, of shape (N, K), lie, and whether the surface is nearer there."""
    places = mesh.vertices[corners]
    owners = np.repeat(np.arange(len(corners)), corners.shape[1])
    points = meeting_points(starts, owners, places.reshape(-1, 3), field, angle)
    middles = places.mean(axis=1)
    size = np.linalg.norm(places - np.roll(places, 1, axis=1), axis=2).max(axis=1)
    near = np.linalg.norm(points - middles, axis=1) < REACH * size
    return points, near & (np.abs(field.sdf(points)) < BETTER * np.abs(field.sdf(middles)))
