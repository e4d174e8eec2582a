"""Signs of normals carried along a minimum spanning tree of nearly parallel tangent planes.

Source: Hoppe et al., *Surface Reconstruction from Unorganized Points* (1992), as open3d has it, with a penalty of edges
that leave the plane. Right for dense scans, open ones included; the sign of the whole is left open, and thin walls and
sparse regions mislead it.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.ingest.winding import outwardness
from gnrecon.runtime.errors import InputError

_NEIGHBOURS = 8
_JITTER = 1e-6  # of the extent
_OPEN = 0.1  # outwardness, in size, that says nothing about inside and outside


def propagated(points: Float, directions: Float, planes: Float, penalty: float) -> Float:
    """Return `directions` with signs propagated along `planes`, outward as a whole, or upward where it is open.

    Parameters
    ----------
    points, directions, planes : arrays of shape (N, 3); points centred and distinct
    penalty : weight against edges of the tree that leave the tangent plane, as where two sheets come close

    Raises
    ------
    InputError
        When the points cannot be triangulated, as fewer than four.
    """
    import open3d

    # The tree comes from a Delaunay triangulation, which fails for exactly cospherical points, so all are moved a bit.
    jitter = _JITTER * np.abs(points).max() * np.random.default_rng(0).normal(size=points.shape)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points + jitter))
    cloud.normals = open3d.utility.Vector3dVector(planes)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        try:
            cloud.orient_normals_consistent_tangent_plane(min(_NEIGHBOURS, len(points) - 1), penalty, 1.0)
        except RuntimeError:  # how open3d reports points that cannot be triangulated
            raise InputError(f"Normals cannot be estimated from {len(points)} points that span no volume.") from None
    signs = np.where(np.einsum("ij,ij->i", directions, np.asarray(cloud.normals)) < 0, -1.0, 1.0)
    normals: Float = directions * signs[:, None]
    side = outwardness(points, normals)
    if abs(side) < _OPEN:
        side = float(normals[:, 2].mean())
    return -normals if side < 0 else normals
