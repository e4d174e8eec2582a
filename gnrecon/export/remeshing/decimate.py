"""Reduces the faces of a mesh: to a number, within a tolerance, or quickly for display.

`decimate` is quadric edge collapse (Garland and Heckbert, 1997; by pymeshlab), which removes what costs the least
squared distance to the planes of the faces; its new vertices are then projected onto the field. `simplify` uses
manifold3d, which removes vertices as long as the surface stays within a distance; the vertices it keeps are on the
field already. Both put faces where the surface bends, and both keep sharp edges.

manifold3d holds its distance collapse by collapse, so that several in a row may add up to more. The distance between
the surfaces is therefore measured, and the simplification repeated with a smaller one until all is within the
tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gnrecon.export.boolean import centre_and_size, from_meshlab, from_solid, manifold_error, to_meshlab, to_solid
from gnrecon.export.metrics import SurfaceQuery, nearest_on_surface
from gnrecon.export.project import SignedDistance, face_sample_points, project
from gnrecon.export.remeshing.edge_table import unit
from gnrecon.export.remeshing.remesh import move_vertices, with_creases
from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.runtime.quiet_imports import import_open3d


def decimate(mesh: Mesh, field: SignedDistance, faces: int, *, angle: float = 30.0) -> Mesh:
    """Reduce a mesh to a number of faces by quadric edge collapse.

    Parameters
    ----------
    mesh : Mesh
        Sound, in file units; from `sharpen` where the field has edges.
    field : SignedDistance
        Whose zero level the mesh is near.
    faces : int
        Wanted number; more are left where fewer would change the surface's topology.
    angle : float
        Degrees between the field's normals on neighbouring faces from which on vertices are put onto their crease.

    Returns
    -------
    Mesh
        On the zero level, with the field's normals; the mesh itself where it has no more faces than wanted.

    Raises
    ------
    UsageError
        When fewer than four faces are wanted.
    """
    # The smallest closed mesh is a tetrahedron.
    if faces < 4:
        raise UsageError(f"The number of faces is {faces}, but a closed mesh has at least 4.")
    if len(mesh.faces) <= faces:
        return mesh
    work = to_meshlab(mesh)
    work.meshing_decimation_quadric_edge_collapse(
        targetfacenum=faces,
        qualitythr=0.5,
        preservenormal=True,
        preservetopology=True,
        planarquadric=True,
        autoclean=False,
    )
    fewer = from_meshlab(work, mesh)
    return project(move_vertices(with_creases(fewer, field, angle), fewer.vertices, field, angle).mesh(), field)


def simplify(mesh: Mesh, field: SignedDistance, tolerance: float, *, attempts: int = 4, safety: float = 0.9) -> Mesh:
    """Remove vertices as long as the surface moves by no more than a tolerance.

    Parameters
    ----------
    mesh : Mesh
        Sound, in file units; from `sharpen` where the field has edges.
    field : SignedDistance
        Whose zero level the vertices lie on.
    tolerance : float, file units
        Greatest distance, either way, between one surface and the other's vertices, edge midpoints and face centres.
    attempts : int
        Most simplifications.
    safety : float
        Margin below the distance that the last attempt suggests for the next one.

    Returns
    -------
    Mesh
        With some of the old vertices where they were, and the field's normals.

    Raises
    ------
    UsageError
        When the tolerance is not positive.
    MeshError
        When nothing is left of the mesh, or no attempt stays within the tolerance.
    """
    if not 0 < tolerance < np.inf:
        raise UsageError(f"The tolerance is {tolerance} file units, but must be positive.")
    distance = tolerance
    for _ in range(attempts):
        simple = simplify_by_collapses(mesh, distance)
        moved = max(_max_distance(mesh, simple), _max_distance(simple, mesh))
        if moved <= tolerance:
            return Mesh(simple.vertices, simple.faces, unit(field.gradient(simple.vertices)))
        distance *= safety * tolerance / moved
    raise MeshError(f"The surface would have moved by {moved:.3g}.")


def simplify_by_collapses(mesh: Mesh, tolerance: float) -> Mesh:
    """Return a mesh as manifold3d simplifies it, by collapses of a tolerance each, in the unit of the vertices.

    Raises
    ------
    MeshError
        When nothing is left of it.
    """
    _, size = centre_and_size(mesh)
    solid = to_solid(mesh, merge=False).simplify(tolerance / size)
    error = manifold_error(solid)
    if error is not None or solid.is_empty():
        raise MeshError(f"manifold3d left nothing of the mesh ({error or 'within the tolerance it is flat'}).")
    return from_solid(solid, mesh)


def _max_distance(one: Mesh, other: Mesh) -> float:
    """Greatest distance to a mesh from another one's vertices, edge midpoints and face centres."""
    points = np.concatenate([other.vertices, face_sample_points(other.corners)])
    return float(nearest_on_surface(one, points)[0].max())


def decimate_by_clustering(mesh: Mesh, faces: int) -> Mesh:
    """Return a lighter mesh for display, with at most `faces` faces and interpolated normals and attributes.

    All vertices within a cube of a regular grid become one (Rossignac and Borrel 1993), at the place of the surface
    that is nearest to their mean. Unlike edge collapse, this keeps as many vertices where a surface is flat as where it
    is curved, and so the detail of its attributes, and it takes seconds for millions of faces. The topology may change.
    A mesh that has so few faces is returned unchanged.
    """
    if len(mesh.faces) <= faces:
        return mesh
    means, triangles = _clustered(mesh, faces)
    vertices, nearest = SurfaceQuery(mesh).nearest(means)
    # Normals and attributes are those of the place on the original surface.
    corners, weights = mesh.faces[nearest], barycentric(mesh.corners[nearest], vertices)
    normals = interpolate(mesh.vertex_normals(), corners, weights)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return Mesh(vertices, triangles, normals, _interpolated_attributes(mesh.attributes, corners, weights))


def _clustered(mesh: Mesh, faces: int, *, faces_per_square: float = 2.3) -> tuple[Float, Int]:
    """Means of clustered vertices, of shape (N, 3), and the faces between them, at most so many.

    The first cube's width follows from about how many faces clustering leaves for each square of surface of its width.
    """
    open3d = import_open3d()

    centre, size = centre_and_size(mesh)
    places = open3d.utility.Vector3dVector((mesh.vertices - centre) / size)
    heavy = open3d.geometry.TriangleMesh(places, open3d.utility.Vector3iVector(mesh.faces))
    cube = np.sqrt(faces_per_square * mesh.area / faces) / size
    light = heavy.simplify_vertex_clustering(cube)
    # The first width is an estimate; wider cubes leave fewer faces.
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


def _interpolated_attributes(attributes: Mapping[str, Values], corners: Int, weights: Float) -> dict[str, Values]:
    """Interpolated attributes in their own types; whole numbers are rounded."""
    carried: dict[str, Values] = {}
    for name, values in attributes.items():
        mixed = interpolate(values, corners, weights)
        whole = np.issubdtype(values.dtype, np.integer)
        carried[name] = (np.round(mixed) if whole else mixed).astype(values.dtype)
    return carried
