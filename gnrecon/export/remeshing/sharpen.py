"""Restores the sharp edges and corners that marching cubes cuts off.

Marching cubes puts vertices on the edges of a lattice only, and so bridges a sharp edge of the surface by chamfers. A
chamfer shows in the field: its ends lie on different sides, so that the normals there differ. Each such mesh edge is
split at the point where the two sides meet, and a face with all three ends on different sides also gets the corner
where they meet: the edge sharpener of Attene, Falcidieno, Rossignac and Spagnuolo (2005), with the field's own planes
in place of estimated ones. Splitting leaves a closed 2-manifold closed and manifold.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.project import SignedDistance, sdf_and_gradient
from gnrecon.export.remeshing.edge_operators import split
from gnrecon.export.remeshing.edge_table import CreasedSurface, EdgeTable, area_vectors, unit
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh


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
    surface = CreasedSurface(mesh.vertices, normals, mesh.faces, np.empty((0, 2), dtype=np.int64))
    plain = np.concatenate([mesh.vertices, mesh.vertices[edges.ends[marked]].mean(axis=1), middles])
    result = split(surface, edges, marked, points[better], np.where(at_corner[:, None], centres, middles))
    return Mesh(_undo_folds(result, plain, len(normals)), result.faces)


def _undo_folds(surface: CreasedSurface, plain: Float, old: int) -> Float:
    """Vertices, of shape (V, 3), with those put back to their `plain` places that fold a face over.

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


def _crease_points(
    mesh: Mesh,
    corners: Int,
    starts: Float,
    field: SignedDistance,
    angle: float,
    *,
    reach_lengths: float = 1.5,
    better_ratio: float = 0.5,
) -> tuple[Float, Mask]:
    """Crease points between the sides on which the corners, of shape (N, K), lie, and which of them to use.

    One is used within `reach_lengths`, in lengths of the chamfer, of its middle, where the field's magnitude is below
    `better_ratio` times that in the middle.
    """
    places = mesh.vertices[corners]
    owners = np.repeat(np.arange(len(corners)), corners.shape[1])
    points = meeting_points(starts, owners, places.reshape(-1, 3), field, angle)
    middles = places.mean(axis=1)
    size = np.linalg.norm(places - np.roll(places, 1, axis=1), axis=2).max(axis=1)
    near = np.linalg.norm(points - middles, axis=1) < reach_lengths * size
    return points, near & (np.abs(field.sdf(points)) < better_ratio * np.abs(field.sdf(middles)))


# Newton's method along the gradient cannot find an edge or a corner of a field, because there the gradient jumps. But
# the surface on either side is smooth. The crease point is the least-squares intersection of the tangent planes at
# points on both sides, as in extended marching cubes (Kobbelt, Botsch, Schwanecke and Seidel, 2001) and in dual
# contouring (Ju, Losasso, Schaefer and Warren, 2002). It moves only in directions that the planes determine: two planes
# move a point only across their line. Then the points on both sides are moved towards it and the planes taken again, so
# that creases between curved surfaces are found too.


def newton_feet(points: Float, field: SignedDistance, steps: int = 2) -> tuple[Float, Float]:
    """Points of shape (N, 3) brought to the zero level by Newton steps, and the field's unit gradients before the last.

    The last step is short, so that the gradient changes little along it, and is not evaluated again.
    """
    for _ in range(steps):
        value, gradient = sdf_and_gradient(field, points)
        squares = np.maximum(np.einsum("ij,ij->i", gradient, gradient), np.finfo(np.float64).tiny)
        points = points - (value / squares)[:, None] * gradient
    return points, unit(gradient)


def crease_edges(normals: Float, edges: EdgeTable, angle: float) -> Mask:
    """Which edges lie between faces whose normals, of shape (F, 3), differ by more than `angle` degrees."""
    one, other = normals[edges.faces[:, 0]], normals[edges.faces[:, 1]]
    return np.asarray(np.einsum("ij,ij->i", one, other) < np.cos(np.radians(angle)))


def meeting_points(
    points: Float,
    owners: Int,
    sides: Float,
    field: SignedDistance,
    angle: float,
    *,
    rounds: int = 3,
    remaining_share: float = 0.3,
) -> Float:
    """Move points to where the adjacent surfaces meet.

    Parameters
    ----------
    points : array of shape (N, 3)
        Near a crease each, file units.
    owners : integer array of shape (S,)
        Which point each of `sides` belongs to.
    sides : array of shape (S, 3)
        Points near the surface on all sides of the crease.
    field : SignedDistance
    angle : float
        Least angle between the sides of a crease in degrees; planes that differ by much less count as one.
    rounds : int
        Times that the planes are taken again.
    remaining_share : float
        Share of the distance to the crease at which the next round takes the planes.

    Returns
    -------
    array of shape (N, 3)
    """
    places, normals = newton_feet(sides, field)
    for _ in range(rounds):
        points = points + _least_squares(points, owners, places, normals, angle)
        nearer, new = newton_feet(points[owners] + remaining_share * (places - points[owners]), field)
        # Past the crease the normal is the other side's: then the plane from farther away is the better one.
        same = np.einsum("ij,ij->i", normals, new) > np.cos(np.radians(angle) / 2)
        places = np.where(same[:, None], nearer, places)
        normals = np.where(same[:, None], new, normals)
    return points + _least_squares(points, owners, places, normals, angle)


def _least_squares(points: Float, owners: Int, places: Float, normals: Float, angle: float) -> Float:
    """Shortest steps, of shape (N, 3), to the points that fit the planes through `places` best."""
    matrix = np.zeros((len(points), 3, 3))
    vector = np.zeros((len(points), 3))
    np.add.at(matrix, owners, normals[:, :, None] * normals[:, None, :])
    heights = np.einsum("ij,ij->i", normals, places - points[owners])
    np.add.at(vector, owners, normals * heights[:, None])
    values, axes = np.linalg.eigh(matrix)
    # Two unit normals at this angle have eigenvalues in the ratio tan(angle / 2)^2.
    known = values > 0.25 * np.tan(np.radians(angle) / 2) ** 2 * values[:, 2:]
    inverse = np.divide(1.0, values, out=np.zeros_like(values), where=known & (values > 0))
    steps: Float = np.einsum("nij,nj,nkj,nk->ni", axes, inverse, axes, vector, optimize=True)
    return steps
