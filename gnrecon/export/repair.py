"""Repairs a mesh that is not quite a solid.

In a sound mesh, only vertices that rounding has brought to one place are joined or moved apart. For any other, three
attempts follow, from the mildest to the strongest, and the first sound result is taken:

1. collapsed, repeated and fin-like faces are dropped, vertices where several fans of faces touch are split, and an
   inside-out mesh is reversed;
2. manifold3d joins open edges whose ends coincide, and pairs up the faces on crowded edges;
3. pymeshlab orients the faces coherently, cuts edges with more than two faces and closes small holes, and the first two
   are tried again.

The entry is `repair`.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.boolean import (
    from_meshlab,
    from_solid,
    imported_pymeshlab,
    manifold_error,
    to_meshlab,
    to_solid,
    with_nearest_normals,
)
from gnrecon.export.export_parameters import ExportParameters
from gnrecon.export.mesh_statistics import Edges, corner_fans, split_vertices, submesh
from gnrecon.export.remeshing.edge_operators import collapse_coincident
from gnrecon.export.verify import require_sound, verify
from gnrecon.geometry.arrays import Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError


def repair(mesh: Mesh) -> tuple[Mesh, list[str]]:
    """Return a sound mesh and one sentence for each change (none if it was sound).

    No two vertices of a sound mesh stay at one place where that can be helped: a format that knows vertices by their
    place, such as STL, would join them.

    Normals are those of the nearest vertex of the given mesh.

    Raises
    ------
    MeshError
        When no attempt gives a sound mesh; the message names the first remaining defect.
    """
    failure = _soundness_error(mesh)
    if failure is None:
        return _without_coincident(mesh), []
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise MeshError(failure)
    tidy, actions = _clean_faces(mesh)
    result, sewing = _sew(tidy)
    if result is None:
        patched, patching = _patch(tidy)
        tidy, tidying = _clean_faces(patched)
        result, sewing = _sew(tidy)
        actions += patching + tidying
    if result is None:
        raise MeshError(f"Repair was not enough: {str(_soundness_error(tidy)).replace('The', 'the', 1)}")
    if mesh.normals is not None and result.normals is None:
        result = with_nearest_normals(result, mesh)
    return result, actions + sewing


def _soundness_error(mesh: Mesh) -> str | None:
    """Why a mesh is not sound, or None."""
    try:
        require_sound(mesh)
    except MeshError as error:
        return str(error)
    return None


def _clean_faces(mesh: Mesh) -> tuple[Mesh, list[str]]:
    """Drop faces that bound nothing, split touching fans, reverse an inside-out mesh."""
    actions = []
    keep = _useful_faces(mesh)
    if not keep.any():
        raise MeshError("The mesh has no face that could bound a solid.")
    if not keep.all():
        actions.append(f"Dropped {np.count_nonzero(~keep)} collapsed, repeated or fin-like faces.")
    tidy = submesh(mesh, keep)
    edges = Edges.of(tidy)
    split = split_vertices(tidy, edges)
    if (edges.count == 2).all() and len(split):
        actions.append(f"Split {len(split)} vertices where several fans of faces touched.")
        tidy = _split_fans(tidy, edges)
    facts = verify(tidy)
    if facts.closed and facts.oriented and facts.volume < 0:
        actions.append("Reversed the faces, because the mesh was inside out.")
        tidy = Mesh(tidy.vertices, tidy.faces[:, ::-1], None if tidy.normals is None else -tidy.normals)
    return tidy, actions


def _useful_faces(mesh: Mesh) -> Mask:
    """Which faces, of shape (F,), are neither collapsed nor repeated nor fins.

    A fin hangs on an edge that has two faces without it, and has an open edge itself.
    """
    faces = mesh.faces
    keep: Mask = ~(faces == np.roll(faces, 1, axis=1)).any(axis=1)
    # With its lowest vertex first, a face equals its repetitions, but not the same face the other way round.
    lowest_first = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    repeated = np.ones(len(faces), dtype=bool)
    repeated[np.unique(lowest_first, axis=0, return_index=True)[1]] = False
    keep &= ~repeated
    # Dropping a fin may turn its neighbours into fins.
    while True:
        rows = np.flatnonzero(keep)
        edges = Edges.of(Mesh(mesh.vertices, faces[rows]))
        shared = np.empty(3 * len(rows), dtype=np.int64)
        shared[edges.corner] = np.repeat(edges.count, edges.count)
        fins = (shared == 1).reshape(-1, 3).any(axis=1) & (shared > 2).reshape(-1, 3).any(axis=1)
        if not fins.any():
            return keep
        keep[rows[fins]] = False


def _split_fans(mesh: Mesh, edges: Edges) -> Mesh:
    """Give each fan of faces a vertex of its own."""
    _, first, faces = np.unique(corner_fans(mesh, edges), return_index=True, return_inverse=True)
    origin = mesh.faces.reshape(-1)[first]
    normals = None if mesh.normals is None else mesh.normals[origin]
    return Mesh(mesh.vertices[origin], faces.reshape(-1, 3), normals)


def _separate_coincident(mesh: Mesh, *, share: float = ExportParameters.repair.separation_share) -> Mesh:
    """Move coincident vertices a share of the way into their own faces, so that no file format joins them again."""
    _, place, count = np.unique(mesh.vertices, axis=0, return_inverse=True, return_counts=True)
    shared = count[place.reshape(-1)] > 1
    if not shared.any():
        return mesh
    # Towards the mean of the middles of its own faces, so that vertices of touching parts move away from each other.
    middle = np.zeros_like(mesh.vertices)
    np.add.at(middle, mesh.faces.reshape(-1), np.repeat(mesh.corners.mean(axis=1), 3, axis=0))
    middle /= np.maximum(np.bincount(mesh.faces.reshape(-1), minlength=len(middle)), 1)[:, None]
    return mesh.with_vertices(
        np.where(shared[:, None], mesh.vertices + share * (middle - mesh.vertices), mesh.vertices)
    )


def _without_coincident(mesh: Mesh) -> Mesh:
    """A sound mesh without vertices at one place; unchanged where it has none, or would not stay sound."""
    if len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices):
        return mesh
    joined = collapse_coincident(mesh)
    separate = _separate_coincident(submesh(joined, np.ones(len(joined.faces), dtype=bool)))
    return separate if _soundness_error(separate) is None else mesh


def _sew(mesh: Mesh) -> tuple[Mesh | None, list[str]]:
    """The mesh if it is sound, else with its edges joined and paired by manifold3d; None where that fails too."""
    separate = _separate_coincident(mesh)
    if _soundness_error(separate) is None:
        return separate, []
    solid = to_solid(mesh, merge=True)
    if manifold_error(solid) is not None or solid.is_empty():
        return None, []
    sewn, tidying = _clean_faces(from_solid(solid, mesh))
    sewn = _separate_coincident(sewn)
    if _soundness_error(sewn) is not None:
        return None, []
    change = f"{len(mesh.faces)} faces became {len(sewn.faces)}"
    return sewn, [f"Joined open and crowded edges with manifold3d: {change}.", *tidying]


def _patch(
    mesh: Mesh,
    *,
    share: float = ExportParameters.repair.separation_share,
    hole_edges: int = ExportParameters.repair.hole_edges,
) -> tuple[Mesh, list[str]]:
    """Cut crowded edges, close small holes and orient the faces with pymeshlab."""
    try:
        pymeshlab = imported_pymeshlab()
    except UsageError:
        raise MeshError("The mesh needs a repair by pymeshlab, which is not installed.") from None
    work = to_meshlab(mesh)
    work.meshing_remove_duplicate_vertices()
    work.meshing_remove_duplicate_faces()
    # Splitting vertices keeps all faces; removing faces would open further holes.
    work.meshing_repair_non_manifold_edges(method="Split Vertices")
    work.meshing_repair_non_manifold_vertices(vertdispratio=share)
    try:
        work.meshing_re_orient_faces_coherently()
        work.meshing_close_holes(maxholesize=hole_edges, selfintersection=False)
    except pymeshlab.PyMeshLabException as error:
        raise MeshError(f"pymeshlab could not repair the mesh ({error}).") from error
    patched = from_meshlab(work, mesh)
    before, after = verify(mesh), verify(patched)
    return patched, [
        f"Patched with pymeshlab: {before.boundary_edges} open, {before.crowded_edges} crowded and "
        f"{before.turned_edges} disagreeing edges became {after.boundary_edges}, {after.crowded_edges} and "
        f"{after.turned_edges}."
    ]
