"""Fewer faces: to a number of faces, or as few as a tolerance allows.

Both put faces where the surface bends, and both keep edges: quadric edge collapse (Garland and Heckbert, 1997; by
pymeshlab) removes what costs the least squared distance to the planes of the faces, and manifold3d's simplification
removes vertices as long as the surface stays within a distance. The former's new vertices are then brought onto the
field; the latter's are some of the old ones, and are there already.

manifold3d holds its distance collapse by collapse, so that several in a row may add up to more. What became of the
surface is therefore measured, and the simplification repeated with a smaller distance until all is within the wanted.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.between import between
from gnrecon.export.meshlab import from_meshlab, to_meshlab
from gnrecon.export.nearest import nearest_on_surface
from gnrecon.export.project import project
from gnrecon.export.protocol import SignedDistance
from gnrecon.export.remesh import creased, settled
from gnrecon.export.solid import centre_and_size, from_solid, refusal, to_solid
from gnrecon.export.surface import unit
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError

FEWEST = 4
"""Faces of a tetrahedron."""

SMALLER = 0.9
"""Margin below the distance that the last attempt suggests for the next one."""

ATTEMPTS = 4


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
    if faces < FEWEST:
        raise UsageError(f"The number of faces is {faces}, but a closed mesh has at least {FEWEST}.")
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
    return project(settled(creased(fewer, field, angle), fewer.vertices, field, angle).mesh(), field)


def simplify(mesh: Mesh, field: SignedDistance, tolerance: float) -> Mesh:
    """Remove vertices as long as the surface moves by no more than a tolerance.

    Parameters
    ----------
    mesh : Mesh
        Sound, in file units; from `sharpen` where the field has edges.
    field : SignedDistance
        Whose zero level the vertices lie on.
    tolerance : float, file units
        Greatest distance, either way, between one surface and the other's vertices, edge midpoints and face centres.

    Returns
    -------
    Mesh
        With some of the old vertices where they were, and the field's normals.

    Raises
    ------
    UsageError
        When the tolerance is not positive.
    MeshError
        When nothing is left of the mesh, or no attempt keeps within the tolerance.
    """
    if not 0 < tolerance < np.inf:
        raise UsageError(f"The tolerance is {tolerance} file units, but must be positive.")
    distance = tolerance
    for _ in range(ATTEMPTS):
        simple = collapsed(mesh, distance)
        moved = max(_farthest(mesh, simple), _farthest(simple, mesh))
        if moved <= tolerance:
            return Mesh(simple.vertices, simple.faces, unit(field.gradient(simple.vertices)))
        distance *= SMALLER * tolerance / moved
    raise MeshError(f"The surface would have moved by {moved:.3g}.")


def collapsed(mesh: Mesh, tolerance: float) -> Mesh:
    """Return a mesh as manifold3d simplifies it, by collapses of a tolerance each, in the unit of the vertices.

    Raises
    ------
    MeshError
        When nothing is left of it.
    """
    _, size = centre_and_size(mesh)
    solid = to_solid(mesh, merge=False).simplify(tolerance / size)
    error = refusal(solid)
    if error is not None or solid.is_empty():
        raise MeshError(f"manifold3d left nothing of the mesh ({error or 'within the tolerance it is flat'}).")
    return from_solid(solid, mesh)


def _farthest(one: Mesh, other: Mesh) -> float:
    """Greatest distance to a mesh from another one's vertices, edge midpoints and face centres."""
    points = np.concatenate([other.vertices, between(other.corners)])
    return float(nearest_on_surface(one, points)[0].max())
