"""The error map: how far each vertex of a mesh lies from the reference, and on which side.

The sign is told by the mesh's own normal n at the vertex p with foot q on the reference: it is that of (p - q) . n. So
it is positive where the mesh lies outside of the reference, whichever way the reference's faces look, whether it is
closed or not, and for references that are points.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.export.nearest import Surface
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud


def vertex_error(mesh: Mesh, reference: Mesh | PointCloud) -> Float:
    """Return the signed distance of each vertex to the nearest place of the reference, of shape (V,), in file units.

    Parameters
    ----------
    mesh : Mesh
    reference : Mesh or PointCloud
        In the same frame and units; a cloud is represented by its points, so that the distance to it is at least a
        share of its spacing.
    """
    if isinstance(reference, Mesh):
        feet = Surface(reference).nearest(mesh.vertices)[0]
    else:
        feet = reference.points[cKDTree(reference.points).query(mesh.vertices)[1]]
    away = mesh.vertices - feet
    outside = np.einsum("ij,ij->i", away, mesh.vertex_normals()) >= 0
    signed: Float = np.linalg.norm(away, axis=1) * np.where(outside, 1.0, -1.0)
    return signed
