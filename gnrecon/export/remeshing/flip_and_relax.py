"""Flipping edges of a surface, so that vertices have six neighbours, or angles grow.

An edge between two faces is replaced by the other diagonal of their quadrilateral. Creases stay, as do edges whose
other diagonal is there already, and those where a face would turn out of the surface or become a sliver. Flips
that share no vertex are made at once, the most useful first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.export.project import SignedDistance
from gnrecon.export.remeshing.edge_table import (
    CREASE,
    SMOOTH,
    CreasedSurface,
    EdgeTable,
    area_vectors,
    face_normals,
    independent_set,
    ranks,
    unit,
)
from gnrecon.export.remeshing.sharpen import meeting_points
from gnrecon.geometry.arrays import Float, Int, Mask

TURN = 0.7
"""Least cosine between a new face's normal and what those of the two old ones should be."""

SHARP = np.radians(20.0)
"""Least angle that a flip for the sake of valence may leave, unless it was smaller before."""

ROUNDS = 8


def flip_for_valence(surface: CreasedSurface) -> CreasedSurface:
    """Flip edges as long as that brings the vertices' numbers of neighbours nearer to six."""
    for _ in range(ROUNDS):
        edges = EdgeTable.of(surface.faces)
        before, after = _least_angles(surface, edges)
        gain = _valence_gain(surface, edges)
        chosen = _independent_flips(
            surface, edges, (gain > 0) & (after > np.minimum(before, SHARP)), gain.astype(np.float64)
        )
        if not len(chosen):
            break
        surface = _flip(surface, edges, chosen)
    return surface


def flip_for_angles(surface: CreasedSurface) -> CreasedSurface:
    """Flip edges as long as the least angle of the two faces grows."""
    for _ in range(ROUNDS):
        edges = EdgeTable.of(surface.faces)
        before, after = _least_angles(surface, edges)
        chosen = _independent_flips(surface, edges, after > before + 1e-6, after - before)
        if not len(chosen):
            break
        surface = _flip(surface, edges, chosen)
    return surface


def _valence_gain(surface: CreasedSurface, edges: EdgeTable) -> Int:
    """By how much the sum of squared deviations from the ideal valence falls, of shape (E,)."""
    valence = np.bincount(edges.ends.reshape(-1), minlength=len(surface.vertices))
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
    short, middle, long = np.maximum(sides, np.finfo(np.float64).tiny).T
    angles: Float = np.arccos(np.clip((long**2 + middle**2 - short**2) / (2 * long * middle), -1.0, 1.0))
    return angles


def _independent_flips(surface: CreasedSurface, edges: EdgeTable, useful: Mask, gain: Float) -> Int:
    """Numbers of useful edges that may be flipped at once."""
    rows = np.flatnonzero(useful & ~surface.is_crease(edges.ends))
    rows = rows[_safe_flips(surface, edges, rows)]
    members = np.concatenate([edges.ends[rows], edges.opposite[rows]], axis=1)
    return rows[independent_set(members, ranks(-gain[rows]), len(surface.vertices))]


def _safe_flips(surface: CreasedSurface, edges: EdgeTable, rows: Int) -> Mask:
    """Whether the other diagonal is new, three edges stay at each end, and the faces look the right way."""
    size = np.array([len(surface.vertices), 1])
    new = np.sort(edges.opposite[rows], axis=1) @ size
    valence = np.bincount(edges.ends.reshape(-1), minlength=size[0])
    safe: Mask = ~np.isin(new, edges.ends @ size) & (valence[edges.ends[rows]] > 3).all(axis=1)
    normals = face_normals(surface)[edges.faces[rows]].sum(axis=1)
    for face in _diagonal_faces(edges, rows):
        areas = area_vectors(surface.vertices, face)
        along = np.einsum("ij,ij->i", areas, normals)
        safe &= along > TURN * np.linalg.norm(areas, axis=1) * np.linalg.norm(normals, axis=1)
    return safe


def _diagonal_faces(edges: EdgeTable, rows: Int) -> tuple[Int, Int]:
    """The two faces beside the other diagonal, each of shape (N, 3)."""
    (a, b), (c, d) = edges.ends[rows].T, edges.opposite[rows].T
    return np.stack([d, b, c], axis=1), np.stack([c, a, d], axis=1)


def _flip(surface: CreasedSurface, edges: EdgeTable, rows: Int) -> CreasedSurface:
    faces = surface.faces.copy()
    for side, new in enumerate(_diagonal_faces(edges, rows)):
        faces[edges.faces[rows, side]] = new
    return replace(surface, faces=faces)


SIDE = 0.5
"""Where beside a crease its sides are looked at: this share of the way from a vertex to the middle of its face."""

REACH = 0.75
"""How far a vertex may go to its crease, as a share of the way to the farthest middle of its faces."""

RELAX_TURN = 0.5
"""Least cosine between a moved face's normal and what it should be, unless it was less before."""


# Spreading a surface's vertices evenly, along the surface and along its creases.


def relax(surface: CreasedSurface) -> Float:
    """Places to which smooth vertices and those of creases move, of shape (V, 3); corners stay.

    Smooth vertices go to the area-weighted middle of their faces, in the tangent plane (Botsch and Kobbelt, 2004);
    vertices of a crease go to the middle of their two neighbours on it, along the line between these.
    """
    kinds = surface.kinds()
    return np.where(
        (kinds == SMOOTH)[:, None],
        _to_middle_of_faces(surface),
        np.where((kinds == CREASE)[:, None], _to_middle_of_crease(surface, kinds), surface.vertices),
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
    both = both[kinds[both[:, 0]] == CREASE]
    order = np.argsort(both[:, 0], kind="stable")
    pairs = both[order].reshape(-1, 2, 2)
    own, one, other = pairs[:, 0, 0], vertices[pairs[:, 0, 1]], vertices[pairs[:, 1, 1]]
    along = unit(other - one)
    places = vertices.copy()
    step = 0.5 * (one + other) - vertices[own]
    places[own] += np.einsum("ij,ij->i", step, along)[:, None] * along
    return places


def snap_to_creases(surface: CreasedSurface, field: SignedDistance, angle: float) -> Float:
    """Places of the vertices, of shape (V, 3), with those of creases where the sides meet, unless that is far off."""
    kinds = surface.kinds()
    rows = np.flatnonzero(kinds != SMOOTH)
    if not len(rows):
        return surface.vertices
    names = np.full(len(kinds), -1, dtype=np.int64)
    names[rows] = np.arange(len(rows))
    corner = np.flatnonzero(names[surface.faces.reshape(-1)] >= 0)
    vertex = surface.faces.reshape(-1)[corner]
    ways = surface.vertices[surface.faces[corner // 3]].mean(axis=1) - surface.vertices[vertex]
    sides = surface.vertices[vertex] + SIDE * ways
    points = meeting_points(surface.vertices[rows], names[vertex], sides, field, angle)
    reach = np.zeros(len(rows))
    np.maximum.at(reach, names[vertex], REACH * np.linalg.norm(ways, axis=1))
    near = np.linalg.norm(points - surface.vertices[rows], axis=1) < reach
    places = surface.vertices.copy()
    places[rows[near]] = points[near]
    return places


def without_flips(surface: CreasedSurface, moved: Float) -> CreasedSurface:
    """The surface over moved vertices, of shape (V, 3), without the moves that would turn a face over.

    Every round returns at least one more vertex, and a face whose three vertices have stayed is as before, so it ends.
    """
    should = face_normals(surface)
    before = _cosines(surface.vertices, surface, should)
    back = np.zeros(len(moved), dtype=bool)
    while True:
        vertices = np.where(back[:, None], surface.vertices, moved)
        after = _cosines(vertices, surface, should)
        again = np.zeros_like(back)
        again[surface.faces[(after < RELAX_TURN) & (after < before)]] = True
        if not (again & ~back).any():
            return replace(surface, vertices=vertices)
        back |= again


def _cosines(vertices: Float, surface: CreasedSurface, should: Float) -> Float:
    return np.asarray(np.einsum("ij,ij->i", unit(area_vectors(vertices, surface.faces)), should))
