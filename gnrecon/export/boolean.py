"""Boolean operations on solids by manifold3d, and the conversions to it and to pymeshlab.

Unlike a surface extracted from the intersection of fields, the result keeps the vertices of the solids, its cuts are
flat, and its rims are sharp. The entries are `crop`, `subtract` and `unite`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.runtime.quiet_imports import import_uninterrupted


def crop(mesh: Mesh, box: Float, *, snap_sizes: float = 1e-9) -> Mesh:
    """Return the part of a solid within a box, closed by flat caps.

    Parameters
    ----------
    mesh : Mesh
        Sound, in file units.
    box : array of shape (2, 3), file units
        Lower and upper corner.
    snap_sizes : float, halves of the mesh's longest side
        Vertices nearer to a cut are put onto it exactly; far more than rounding, far less than an edge.

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
    manifold3d = import_uninterrupted("manifold3d")

    centre, size = centre_and_size(mesh)
    corner, sides = (low - centre) / size, (high - low) / size
    block = manifold3d.Manifold.cube(sides.tolist()).translate(corner.tolist())
    part = _mesh_of(to_solid(mesh, merge=False) ^ block, mesh)
    if part is None:
        raise MeshError("Nothing of the shape lies in the crop box.")
    # Scaling back rounds: vertices of the cut are put onto the sides of the box exactly.
    vertices = part.vertices.copy()
    on_cap = np.zeros(len(vertices), dtype=bool)
    for side in (low, high):
        near = np.abs(vertices - side) <= snap_sizes * size
        vertices = np.where(near, side, vertices)
        on_cap |= near.any(axis=1)
    return with_nearest_normals(part.with_vertices(vertices), mesh, ~on_cap)


def subtract(outer: Mesh, inner: Mesh) -> Mesh:
    """Return the difference of two solids, both sound and in file units.

    Raises
    ------
    MeshError
        When nothing is left.
    """
    centre, size = centre_and_size(outer)
    # Both solids in the outer one's centred coordinates.
    moved = to_solid(inner, merge=False)
    inner_centre, inner_size = centre_and_size(inner)
    moved = moved.scale([inner_size / size] * 3).translate(((inner_centre - centre) / size).tolist())
    rest = _mesh_of(to_solid(outer, merge=False) - moved, outer)
    if rest is None:
        raise MeshError("Nothing is left of the solid.")
    # Inner walls face the other way once the inner solid is taken away.
    walls = Mesh(
        np.concatenate([outer.vertices, inner.vertices]),
        np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]),
        np.concatenate([outer.vertex_normals(), -inner.vertex_normals()]),
    )
    return with_nearest_normals(rest, walls)


def unite(mesh: Mesh, hulls: Sequence[Float]) -> Mesh:
    """Return the union of a solid and the convex hulls of points, each of shape (N, 3); all in file units.

    Raises
    ------
    MeshError
        When manifold3d fails.
    """
    manifold3d = import_uninterrupted("manifold3d")

    centre, size = centre_and_size(mesh)
    parts = [manifold3d.Manifold.hull_points((points - centre) / size) for points in hulls]
    whole = _mesh_of(
        manifold3d.Manifold.batch_boolean([to_solid(mesh, merge=False), *parts], manifold3d.OpType.Add), mesh
    )
    return mesh if whole is None else with_nearest_normals(whole, mesh)


def _mesh_of(solid: object, like: Mesh) -> Mesh | None:
    """A result as a mesh, or None where it is empty.

    Raises
    ------
    MeshError
        When manifold3d fails.
    """
    error = manifold_error(solid)
    if error is not None:
        raise MeshError(f"manifold3d could not cut the solid ({error}).")
    mesh = from_solid(solid, like)
    return mesh if len(mesh.faces) else None


def with_nearest_normals(mesh: Mesh, source: Mesh, where: Mask | None = None) -> Mesh:
    """Give vertices, all or those of a mask, the normal of the source's nearest vertex, and others their faces' mean.

    A normal that points to the other side than the faces is not taken either: that of a patch, or of a reversed mesh.
    """
    by_faces = mesh.vertex_normals()
    normals = source.vertex_normals()[cKDTree(source.vertices).query(mesh.vertices)[1]]
    fits = np.einsum("ij,ij->i", normals, by_faces) > 0
    if where is not None:
        fits &= where
    return Mesh(mesh.vertices, mesh.faces, np.where(fits[:, None], normals, by_faces))


# Conversions: positions are relative to the mesh's own centre and size, in float64.


def centre_and_size(mesh: Mesh) -> tuple[Float, float]:
    """Middle of the bounding box, of shape (3,), and half its longest side (1 for a single point)."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return (low + high) / 2, float((high - low).max() / 2) or 1.0


def to_solid(mesh: Mesh, *, merge: bool) -> Any:
    """Convert a non-empty mesh for manifold3d; `manifold_error` says whether it is an oriented 2-manifold.

    Coordinates are centred and scaled to one, because manifold3d's tolerances are relative to the largest coordinate.
    With `merge`, open edges whose ends coincide are joined.
    """
    manifold3d = import_uninterrupted("manifold3d")

    centre, size = centre_and_size(mesh)
    data = manifold3d.Mesh64((mesh.vertices - centre) / size, mesh.faces.astype(np.uint64))
    if merge:
        data.merge()
    return manifold3d.Manifold(data)


def from_solid(solid: Any, like: Mesh) -> Mesh:
    """Convert a solid back, to the position and size of the mesh that it was made from."""
    centre, size = centre_and_size(like)
    data = solid.to_mesh64()
    return Mesh(centre + size * data.vert_properties[:, :3], data.tri_verts.astype(np.int64))


def manifold_error(solid: Any) -> str | None:
    """Name of manifold3d's error, or None where it accepts the solid."""
    manifold3d = import_uninterrupted("manifold3d")

    status = solid.status()
    return None if status == manifold3d.Error.NoError else str(status.name)


def to_meshlab(mesh: Mesh) -> Any:
    """Return a `pymeshlab.MeshSet` of a non-empty mesh's vertices and faces.

    Coordinates are centred and scaled to one, because some of pymeshlab's thresholds are lengths.

    Raises
    ------
    UsageError
        When pymeshlab, whose licence is the GPL, is not installed.
    """
    pymeshlab = imported_pymeshlab()
    centre, size = centre_and_size(mesh)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh((mesh.vertices - centre) / size, mesh.faces.astype(np.int32)))
    return meshes


def imported_pymeshlab() -> Any:
    """Return the package pymeshlab.

    Raises
    ------
    UsageError
        When it is not installed; everything that does not need it works without.
    """
    try:
        import pymeshlab
    except ImportError:
        raise UsageError("This needs the package pymeshlab; install it with: pip install pymeshlab") from None
    return pymeshlab


def from_meshlab(meshes: Any, like: Mesh) -> Mesh:
    """Convert the current mesh back, to the position and size of the mesh that it was made from."""
    centre, size = centre_and_size(like)
    result = meshes.current_mesh()
    return Mesh(centre + size * result.vertex_matrix(), result.face_matrix().astype(np.int64))
