"""Flipping edges of a surface, so that vertices have six neighbours, or angles grow.

An edge between two faces is replaced by the other diagonal of their quadrilateral. Creases stay, as do edges whose
other diagonal is there already, and those where a face would turn out of the surface or become a sliver. Flips
that share no vertex are made at once, the most useful first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.export.independent import apart, ranks
from gnrecon.export.surface import EdgeTable, Surface, area_vectors, face_normals
from gnrecon.geometry.arrays import Float, Int, Mask

TURN = 0.7
"""Least cosine between a new face's normal and what those of the two old ones should be."""

SHARP = np.radians(20.0)
"""Least angle that a flip for the sake of valence may leave, unless it was smaller before."""

ROUNDS = 8


def flip_for_valence(surface: Surface) -> Surface:
    """Flip edges as long as that brings the vertices' numbers of neighbours nearer to six."""
    for _ in range(ROUNDS):
        edges = EdgeTable.of(surface.faces)
        before, after = _least_angles(surface, edges)
        gain = _valence_gain(surface, edges)
        chosen = _chosen(surface, edges, (gain > 0) & (after > np.minimum(before, SHARP)), gain.astype(np.float64))
        if not len(chosen):
            break
        surface = _flipped(surface, edges, chosen)
    return surface


def flip_for_angles(surface: Surface) -> Surface:
    """Flip edges as long as the least angle of the two faces grows."""
    for _ in range(ROUNDS):
        edges = EdgeTable.of(surface.faces)
        before, after = _least_angles(surface, edges)
        chosen = _chosen(surface, edges, after > before + 1e-6, after - before)
        if not len(chosen):
            break
        surface = _flipped(surface, edges, chosen)
    return surface


def _valence_gain(surface: Surface, edges: EdgeTable) -> Int:
    """By how much the sum of squared deviations from the ideal valence falls, of shape (E,)."""
    valence = np.bincount(edges.ends.reshape(-1), minlength=len(surface.vertices))
    off = valence - 6
    ends, opposite = off[edges.ends], off[edges.opposite]
    gain: Int = (ends**2 - (ends - 1) ** 2).sum(axis=1) + (opposite**2 - (opposite + 1) ** 2).sum(axis=1)
    return gain


def _least_angles(surface: Surface, edges: EdgeTable) -> tuple[Float, Float]:
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


def _chosen(surface: Surface, edges: EdgeTable, useful: Mask, gain: Float) -> Int:
    """Numbers of useful edges that may be flipped at once."""
    rows = np.flatnonzero(useful & ~surface.is_crease(edges.ends))
    rows = rows[_safe(surface, edges, rows)]
    members = np.concatenate([edges.ends[rows], edges.opposite[rows]], axis=1)
    return rows[apart(members, ranks(-gain[rows]), len(surface.vertices))]


def _safe(surface: Surface, edges: EdgeTable, rows: Int) -> Mask:
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


def _flipped(surface: Surface, edges: EdgeTable, rows: Int) -> Surface:
    faces = surface.faces.copy()
    for side, new in enumerate(_diagonal_faces(edges, rows)):
        faces[edges.faces[rows, side]] = new
    return replace(surface, faces=faces)
