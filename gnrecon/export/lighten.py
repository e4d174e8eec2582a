"""A lighter copy of a mesh, for looking at: fewer faces by clustering vertices, attributes included.

All vertices within a cube of a regular grid become one (Rossignac and Borrel 1993), at the place of the surface that
is nearest to their mean, with the attributes of that place. Unlike collapsing edges by their error, this keeps as many
vertices where a surface is flat as where it is curved, and so the detail of its attributes; and it takes seconds for
millions of faces. Nothing is promised of the copy's topology.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gnrecon.export.nearest import Surface
from gnrecon.export.solid import centre_and_size
from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.geometry.mesh import Mesh

DENSITY = 2.3
"""Faces that clustering leaves for each square of the surface that is as wide as a cube, about."""


def lighten(mesh: Mesh, faces: int) -> Mesh:
    """Return the mesh with at most `faces` faces, its normals and attributes interpolated.

    A mesh that has so few is returned as it is.
    """
    if len(mesh.faces) <= faces:
        return mesh
    means, triangles = _clustered(mesh, faces)
    vertices, nearest = Surface(mesh).nearest(means)
    corners, weights = mesh.faces[nearest], barycentric(mesh.corners[nearest], vertices)
    normals = interpolate(mesh.vertex_normals(), corners, weights)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return Mesh(vertices, triangles, normals, _carried(mesh.attributes, corners, weights))


def _clustered(mesh: Mesh, faces: int) -> tuple[Float, Int]:
    """Means of clustered vertices, of shape (N, 3), and the faces between them, at most so many."""
    import open3d

    centre, size = centre_and_size(mesh)
    places = open3d.utility.Vector3dVector((mesh.vertices - centre) / size)
    heavy = open3d.geometry.TriangleMesh(places, open3d.utility.Vector3iVector(mesh.faces))
    cube = np.sqrt(DENSITY * mesh.area / faces) / size
    light = heavy.simplify_vertex_clustering(cube)
    while len(light.triangles) > faces:
        cube *= 1.1
        light = heavy.simplify_vertex_clustering(cube)
    return centre + size * np.asarray(light.vertices), np.asarray(light.triangles, dtype=np.int64)


def barycentric(corners: Float, places: Float) -> Float:
    """Return the shares of triangles' corners in places within them, of shape (N, 3); a third each without an area.

    Parameters
    ----------
    corners : array of shape (N, 3, 3)
    places : array of shape (N, 3)
    """
    to = corners - places[:, None]
    areas = np.stack([np.cross(to[:, (k + 1) % 3], to[:, (k + 2) % 3]) for k in range(3)], axis=1)
    sizes = np.linalg.norm(areas, axis=2) + np.finfo(np.float64).tiny
    weights: Float = sizes / sizes.sum(axis=1, keepdims=True)
    return weights


def interpolate(values: Values, corners: Int, weights: Float) -> Float:
    """Return values of shape (N, ...) at places in faces, from the values of vertices, of shape (V, ...).

    Parameters
    ----------
    values : array of shape (V,) or (V, C)
    corners : integer array of shape (N, 3)
        Vertices of the face that each place lies in.
    weights : array of shape (N, 3)
        Barycentric coordinates.
    """
    mixed: Float = np.einsum("nk,nk...->n...", weights, values[corners].astype(np.float64))
    return mixed


def _carried(attributes: Mapping[str, Values], corners: Int, weights: Float) -> dict[str, Values]:
    """Interpolated attributes in their own types; whole numbers are rounded."""
    carried: dict[str, Values] = {}
    for name, values in attributes.items():
        mixed = interpolate(values, corners, weights)
        whole = np.issubdtype(values.dtype, np.integer)
        carried[name] = (np.round(mixed) if whole else mixed).astype(values.dtype)
    return carried
