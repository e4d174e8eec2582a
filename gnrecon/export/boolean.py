"""Exact operations on solids by manifold3d: cutting a box out of one, and taking one away from another.

Unlike a surface extracted from the intersection of fields, the result keeps the vertices of the solids, its cuts are
flat, and its rims are sharp.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

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
    error = manifold_error(solid)
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


# The mesh as manifold3d sees it: positions relative to the mesh's own centre and size, in float64.


def centre_and_size(mesh: Mesh) -> tuple[Float, float]:
    """Middle of the bounding box, of shape (3,), and half its longest side (1 for a single point)."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return (low + high) / 2, float((high - low).max() / 2) or 1.0


def to_solid(mesh: Mesh, *, merge: bool) -> Any:
    """Hand a non-empty mesh to manifold3d; the result's ``status()`` tells whether it is an oriented 2-manifold.

    Coordinates are centred and scaled to one, because manifold3d's tolerances are relative to the largest coordinate.
    `merge` lets it sew open edges whose ends coincide.
    """
    import manifold3d

    centre, size = centre_and_size(mesh)
    data = manifold3d.Mesh64((mesh.vertices - centre) / size, mesh.faces.astype(np.uint64))
    if merge:
        data.merge()
    return manifold3d.Manifold(data)


def from_solid(solid: Any, like: Mesh) -> Mesh:
    """Bring a solid back into the place and size of the mesh that it was made from."""
    centre, size = centre_and_size(like)
    data = solid.to_mesh64()
    return Mesh(centre + size * data.vert_properties[:, :3], data.tri_verts.astype(np.int64))


def manifold_error(solid: Any) -> str | None:
    """Name of manifold3d's error, or None where it accepts the solid."""
    import manifold3d

    status = solid.status()
    return None if status == manifold3d.Error.NoError else str(status.name)


# The mesh as pymeshlab sees it: positions relative to the mesh's own centre and size, in float64.


def to_meshlab(mesh: Mesh) -> Any:
    """Return a `pymeshlab.MeshSet` of a non-empty mesh's vertices and faces alone.

    Coordinates are centred and scaled to one, because some of pymeshlab's thresholds are lengths.
    """
    import pymeshlab

    centre, size = centre_and_size(mesh)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh((mesh.vertices - centre) / size, mesh.faces.astype(np.int32)))
    return meshes


def from_meshlab(meshes: Any, like: Mesh) -> Mesh:
    """Bring the current mesh back into the place and size of the mesh that it was made from."""
    centre, size = centre_and_size(like)
    result = meshes.current_mesh()
    return Mesh(centre + size * result.vertex_matrix(), result.face_matrix().astype(np.int64))
