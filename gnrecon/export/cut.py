"""Exact operations on solids by manifold3d: cutting a box out of one, and taking one away from another.

Unlike a surface extracted from the intersection of fields, the result keeps the vertices of the solids, its cuts are
flat, and its rims are sharp.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.export.solid import centre_and_size, from_solid, refusal, to_solid
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError

SNAP = 1e-9
"""Vertices within this share of the mesh's size from a cut are put onto it exactly."""


def crop(mesh: Mesh, box: Float) -> Mesh:
    """Return the part of a solid within a box, closed by flat caps.

    Parameters
    ----------
    mesh : Mesh
        Sound, in file units.
    box : array of shape (2, 3), file units
        Lower and upper corner.

    Returns
    -------
    Mesh
        The mesh itself where it lies within the box. Normals are those of the mesh, and on caps the faces'.

    Raises
    ------
    MeshError
        When nothing of the solid lies in the box.
    """
    low, high = np.asarray(box, dtype=np.float64)
    if (mesh.vertices >= low).all() and (mesh.vertices <= high).all():
        return mesh
    import manifold3d

    centre, size = centre_and_size(mesh)
    corner, sides = (low - centre) / size, (high - low) / size
    block = manifold3d.Manifold.cube(sides.tolist()).translate(corner.tolist())
    part = _mesh_of(to_solid(mesh, merge=False) ^ block, mesh)
    if part is None:
        raise MeshError("Nothing of the shape lies in the box that it is cropped to.")
    vertices = part.vertices.copy()
    on_cap = np.zeros(len(vertices), dtype=bool)
    for side in (low, high):
        near = np.abs(vertices - side) <= SNAP * size
        vertices = np.where(near, side, vertices)
        on_cap |= near.any(axis=1)
    return _with_normals(part.with_vertices(vertices), mesh, ~on_cap)


def subtract(outer: Mesh, inner: Mesh) -> Mesh:
    """Return a solid without what another one takes up; both sound and in file units.

    Raises
    ------
    MeshError
        When nothing is left.
    """
    centre, size = centre_and_size(outer)
    moved = to_solid(inner, merge=False)
    inner_centre, inner_size = centre_and_size(inner)
    moved = moved.scale([inner_size / size] * 3).translate(((inner_centre - centre) / size).tolist())
    rest = _mesh_of(to_solid(outer, merge=False) - moved, outer)
    if rest is None:
        raise MeshError("Nothing is left of the solid.")
    walls = Mesh(
        np.concatenate([outer.vertices, inner.vertices]),
        np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]),
        np.concatenate([outer.vertex_normals(), -inner.vertex_normals()]),
    )
    return _with_normals(rest, walls, np.ones(len(rest.vertices), dtype=bool))


def _mesh_of(solid: object, like: Mesh) -> Mesh | None:
    """A result as a mesh, or None where it is empty.

    Raises
    ------
    MeshError
        When manifold3d could not do what it was asked.
    """
    error = refusal(solid)
    if error is not None:
        raise MeshError(f"The solid could not be cut: manifold3d says {error}.")
    mesh = from_solid(solid, like)
    return mesh if len(mesh.faces) else None


def _with_normals(mesh: Mesh, source: Mesh, old: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Mesh:
    """Give vertices of the old surface the normal of the source's nearest vertex, and all others their faces' mean."""
    by_faces = mesh.vertex_normals()
    normals = source.vertex_normals()[cKDTree(source.vertices).query(mesh.vertices)[1]]
    fits = old & (np.einsum("ij,ij->i", normals, by_faces) > 0)
    return Mesh(mesh.vertices, mesh.faces, np.where(fits[:, None], normals, by_faces))
