"""The mesh as manifold3d sees it: positions relative to the mesh's own centre and size, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh


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


def refusal(solid: Any) -> str | None:
    """Name of manifold3d's error, or None where it accepts the solid."""
    import manifold3d

    status = solid.status()
    return None if status == manifold3d.Error.NoError else str(status.name)
