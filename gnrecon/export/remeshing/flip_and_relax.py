"""Flips edges of a surface, so that vertices have six neighbours or angles grow, and relaxes its vertices.

An edge between two faces is replaced by the other diagonal of their quadrilateral. Creases stay, as do edges whose
other diagonal exists already, and those where a face would turn away from the surface or become a sliver. Flips that
share no vertex are made at once, those with the greatest gain first. Relaxation spreads vertices evenly along the
surface and along its creases.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.export.project import SignedDistance
from gnrecon.export.remeshing.edge_table import (
    CreasedSurface,
    EdgeTable,
    VertexKind,
    area_vectors,
    face_normals,
    independent_set,
    ranks,
    unit,
)
from gnrecon.export.remeshing.sharpen import meeting_points
from gnrecon.geometry.arrays import Float, Int, Mask


def flip_for_valence(
    surface: CreasedSurface, *, most_rounds: int = 8, least_angle_degrees: float = 20.0
) -> CreasedSurface:
    """Flip edges as long as that brings the vertices' numbers of neighbours nearer to six.

    A flip may leave no angle below `least_angle_degrees`, unless it was smaller before.
    """
    least_angle = np.radians(least_angle_degrees)
    for _ in range(most_rounds):
        edges = EdgeTable.of(surface.faces)
        before, after = _least_angles(surface, edges)
        gain = _valence_gain(surface, edges)
        chosen = _independent_flips(
            surface, edges, (gain > 0) & (after > np.minimum(before, least_angle)), gain.astype(np.float64)
        )
        if not len(chosen):
            break
        surface = _flip(surface, edges, chosen)
    return surface


def flip_for_angles(surface: CreasedSurface, *, most_rounds: int = 8) -> CreasedSurface:
    """Flip edges as long as the least angle of the two faces grows."""
    for _ in range(most_rounds):
        edges = EdgeTable.of(surface.faces)
        before, after = _least_angles(surface, edges)
        # The threshold is above rounding, so that equal diagonals are not flipped back and forth.
        chosen = _independent_flips(surface, edges, after > before + 1e-6, after - before)
        if not len(chosen):
            break
        surface = _flip(surface, edges, chosen)
    return surface


def _valence_gain(surface: CreasedSurface, edges: EdgeTable) -> Int:
    """By how much the sum of squared deviations from the ideal valence falls, of shape (E,)."""
    valence = np.bincount(edges.ends.reshape(-1), minlength=len(surface.vertices))
    # In a regular triangulation every vertex has six neighbours. A flip takes one from each end and gives one to each
    # opposite vertex.
    off = valence - 6
    ends, opposite = off[edges.ends], off[edges.opposite]
    gain: Int = (ends**2 - (ends - 1) ** 2).sum(axis=1) + (opposite**2 - (opposite + 1) ** 2).sum(axis=1)
    return gain


def _least_angles(surface: CreasedSurface, edges: EdgeTable) -> tuple[Float, Float]:
    """Least angle of the two faces of each edge, now and with the other diagonal, of shape (E,), radians."""
    a, b = edges.ends.T
    c, d = edges.opposite.T
    now = np.minimum(_least_angle(surface.vertices, a, b, c), _least_angle(surface.vertices, b, a, d))
    then = np.minimum(_least_angle(surface.vertices, c, d, b), _least_angle(surface.vertices, d, c, a))
    return now, then


def _least_angle(vertices: Float, a: Int, b: Int, c: Int) -> Float:
    """Least angle of triangles by their corners' numbers, of shape (N,), radians."""
    corners = vertices[np.stack([a, b, c], axis=1)]
    sides = np.sort(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2), axis=1)
    # The law of cosines at the corner that faces the shortest side.
    short, middle, long = np.maximum(sides, np.finfo(np.float64).tiny).T
    angles: Float = np.arccos(np.clip((long**2 + middle**2 - short**2) / (2 * long * middle), -1.0, 1.0))
    return angles


def _independent_flips(surface: CreasedSurface, edges: EdgeTable, useful: Mask, gain: Float) -> Int:
    """Numbers of useful edges that may be flipped at once."""
    rows = np.flatnonzero(useful & ~surface.is_crease(edges.ends))
    rows = rows[_safe_flips(surface, edges, rows)]
    members = np.concatenate([edges.ends[rows], edges.opposite[rows]], axis=1)
    return rows[independent_set(members, ranks(-gain[rows]), len(surface.vertices))]


def _safe_flips(surface: CreasedSurface, edges: EdgeTable, rows: Int, *, least_cosine: float = 0.7) -> Mask:
    """Whether the other diagonal is new, three edges stay at each end, and the new faces do not turn.

    A face turns where the cosine between its normal and the expected one of the two old faces is below `least_cosine`.
    """
    size = np.array([len(surface.vertices), 1])
    new = np.sort(edges.opposite[rows], axis=1) @ size
    valence = np.bincount(edges.ends.reshape(-1), minlength=size[0])
    safe: Mask = ~np.isin(new, edges.ends @ size) & (valence[edges.ends[rows]] > 3).all(axis=1)
    normals = face_normals(surface)[edges.faces[rows]].sum(axis=1)
    for face in _diagonal_faces(edges, rows):
        areas = area_vectors(surface.vertices, face)
        along = np.einsum("ij,ij->i", areas, normals)
        safe &= along > least_cosine * np.linalg.norm(areas, axis=1) * np.linalg.norm(normals, axis=1)
    return safe


def _diagonal_faces(edges: EdgeTable, rows: Int) -> tuple[Int, Int]:
    """The two faces at the other diagonal, each of shape (N, 3)."""
    (a, b), (c, d) = edges.ends[rows].T, edges.opposite[rows].T
    return np.stack([d, b, c], axis=1), np.stack([c, a, d], axis=1)


def _flip(surface: CreasedSurface, edges: EdgeTable, rows: Int) -> CreasedSurface:
    faces = surface.faces.copy()
    for side, new in enumerate(_diagonal_faces(edges, rows)):
        faces[edges.faces[rows, side]] = new
    return replace(surface, faces=faces)


def relax(surface: CreasedSurface) -> Float:
    """Relaxed positions of smooth vertices and those of creases, of shape (V, 3); corners stay.

    Smooth vertices go to the area-weighted middle of their faces, in the tangent plane (Botsch and Kobbelt, 2004);
    vertices of a crease go to the middle of their two neighbours on it, along the line between these.
    """
    kinds = surface.kinds()
    return np.where(
        (kinds == VertexKind.SMOOTH)[:, None],
        _to_middle_of_faces(surface),
        np.where((kinds == VertexKind.CREASE)[:, None], _to_middle_of_crease(surface, kinds), surface.vertices),
    )


def _to_middle_of_faces(surface: CreasedSurface) -> Float:
    vertices, faces = surface.vertices, surface.faces
    areas = area_vectors(vertices, faces)
    size = np.linalg.norm(areas, axis=1)
    moment = np.zeros((len(vertices), 3))
    normal = np.zeros((len(vertices), 3))
    total = np.zeros(len(vertices))
    middles = size[:, None] * vertices[faces].mean(axis=1)
    for corner in faces.T:
        np.add.at(moment, corner, middles)
        np.add.at(normal, corner, areas)
        np.add.at(total, corner, size)
    step = moment / np.maximum(total, np.finfo(np.float64).tiny)[:, None] - vertices
    normal = unit(normal)
    places: Float = vertices + step - np.einsum("ij,ij->i", step, normal)[:, None] * normal
    return places


def _to_middle_of_crease(surface: CreasedSurface, kinds: Int) -> Float:
    vertices = surface.vertices
    both = np.concatenate([surface.creases, surface.creases[:, ::-1]])
    both = both[kinds[both[:, 0]] == VertexKind.CREASE]
    order = np.argsort(both[:, 0], kind="stable")
    pairs = both[order].reshape(-1, 2, 2)
    own, one, other = pairs[:, 0, 0], vertices[pairs[:, 0, 1]], vertices[pairs[:, 1, 1]]
    # Only along the crease: across it the vertex would leave the surface.
    along = unit(other - one)
    places = vertices.copy()
    step = 0.5 * (one + other) - vertices[own]
    places[own] += np.einsum("ij,ij->i", step, along)[:, None] * along
    return places


def snap_to_creases(
    surface: CreasedSurface, field: SignedDistance, angle: float, *, side_share: float = 0.5, reach_share: float = 0.75
) -> Float:
    """Positions of the vertices, of shape (V, 3), with those of creases moved to where the sides meet.

    The sides are sampled at `side_share` of the way from a vertex to the middles of its faces. It moves by no more than
    `reach_share` of the way to the farthest of these.
    """
    kinds = surface.kinds()
    rows = np.flatnonzero(kinds != VertexKind.SMOOTH)
    if not len(rows):
        return surface.vertices
    names = np.full(len(kinds), -1, dtype=np.int64)
    names[rows] = np.arange(len(rows))
    corner = np.flatnonzero(names[surface.faces.reshape(-1)] >= 0)
    vertex = surface.faces.reshape(-1)[corner]
    ways = surface.vertices[surface.faces[corner // 3]].mean(axis=1) - surface.vertices[vertex]
    sides = surface.vertices[vertex] + side_share * ways
    points = meeting_points(surface.vertices[rows], names[vertex], sides, field, angle)
    reach = np.zeros(len(rows))
    np.maximum.at(reach, names[vertex], reach_share * np.linalg.norm(ways, axis=1))
    near = np.linalg.norm(points - surface.vertices[rows], axis=1) < reach
    places = surface.vertices.copy()
    places[rows[near]] = points[near]
    return places


def without_flips(surface: CreasedSurface, moved: Float, *, least_cosine: float = 0.5) -> CreasedSurface:
    """The surface over moved vertices, of shape (V, 3), without the moves that would turn a face over.

    A face is turned where the cosine between its normal and the expected one is below `least_cosine`, and smaller than
    before. It ends, because each round restores at least one more vertex.
    """
    should = face_normals(surface)
    before = _cosines(surface.vertices, surface, should)
    back = np.zeros(len(moved), dtype=bool)
    while True:
        vertices = np.where(back[:, None], surface.vertices, moved)
        after = _cosines(vertices, surface, should)
        again = np.zeros_like(back)
        again[surface.faces[(after < least_cosine) & (after < before)]] = True
        if not (again & ~back).any():
            return replace(surface, vertices=vertices)
        back |= again


def _cosines(vertices: Float, surface: CreasedSurface, should: Float) -> Float:
    return np.asarray(np.einsum("ij,ij->i", unit(area_vectors(vertices, surface.faces)), should))
