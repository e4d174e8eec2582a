"""The mesh as pymeshlab sees it: positions relative to the mesh's own centre and size, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.export.solid import centre_and_size
from gnrecon.geometry.mesh import Mesh


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
