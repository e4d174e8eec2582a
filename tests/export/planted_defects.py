"""Meshes with one defect each."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.mesh import Mesh


def touching_in_a_vertex(mesh: Mesh) -> Mesh:
    """The mesh and a copy of it that shares its rightmost vertex with the copy's leftmost one."""
    right, left = mesh.vertices[:, 0].argmax(), mesh.vertices[:, 0].argmin()
    copy = mesh.vertices + (mesh.vertices[right] - mesh.vertices[left])
    faces = mesh.faces + len(copy)
    faces[mesh.faces == left] = right
    return Mesh(np.concatenate([mesh.vertices, copy]), np.concatenate([mesh.faces, faces]))


def touching_in_an_edge() -> Mesh:
    """Two unit cubes that share an edge, and so an edge with four faces."""
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices, names = np.unique(np.concatenate([cube, cube + np.array([1, 1, 0])]), axis=0, return_inverse=True)
    return Mesh(vertices, names.reshape(-1)[np.concatenate([faces, faces + 8])])


def with_a_fin(mesh: Mesh) -> Mesh:
    """One more face on an edge that has its two."""
    a, b = mesh.faces[0, :2]
    return Mesh(np.vstack([mesh.vertices, [[0, 0, 2.0]]]), np.vstack([mesh.faces, [[a, b, len(mesh.vertices)]]]))


def with_a_flipped_face(mesh: Mesh) -> Mesh:
    faces = mesh.faces.copy()
    faces[7] = faces[7, ::-1]
    return Mesh(mesh.vertices, faces)
