"""Spreading a surface's vertices evenly, along the surface and along its creases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.export.crease import meeting_points
from gnrecon.export.protocol import SignedDistance
from gnrecon.export.surface import CREASE, SMOOTH, Surface, area_vectors, face_normals, unit
from gnrecon.geometry.arrays import Float, Int

SIDE = 0.5
"""Where beside a crease its sides are looked at: this share of the way from a vertex to the middle of its face."""

REACH = 0.75
"""How far a vertex may go to its crease, as a share of the way to the farthest middle of its faces."""

TURN = 0.5
"""Least cosine between a moved face's normal and what it should be, unless it was less before."""


def relaxed(surface: Surface) -> Float:
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


def _to_middle_of_faces(surface: Surface) -> Float:
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


def _to_middle_of_crease(surface: Surface, kinds: Int) -> Float:
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


def on_creases(surface: Surface, field: SignedDistance, angle: float) -> Float:
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


def guarded(surface: Surface, moved: Float) -> Surface:
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
        again[surface.faces[(after < TURN) & (after < before)]] = True
        if not (again & ~back).any():
            return replace(surface, vertices=vertices)
        back |= again


def _cosines(vertices: Float, surface: Surface, should: Float) -> Float:
    return np.asarray(np.einsum("ij,ij->i", unit(area_vectors(vertices, surface.faces)), should))
