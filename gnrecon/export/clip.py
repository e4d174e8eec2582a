"""Cut a mesh off at the sides of a box, and leave it open there.

Faces that cross a side are cut along it, by linear interpolation along their edges; a crossing keeps a tenth of its
edge away from both ends, as in `trim`, so that no face becomes a sliver. Where the sides are planes of the lattice that
the mesh was extracted on, no face crosses them and the border lies in them exactly.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.trim import cut_along, used
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

ON = 1e-9
"""Distance, as a share of the box's diagonal, at which a vertex is on a side."""


def clip(mesh: Mesh, bounds: Float) -> Mesh:
    """Return the part of an oriented 2-manifold within a box; it has no faces where nothing is inside.

    Parameters
    ----------
    mesh : Mesh
        Normals and attributes are interpolated at the cut.
    bounds : array of shape (2, 3)
        Lower and upper corner.
    """
    tolerance = ON * float(np.linalg.norm(bounds[1] - bounds[0]))
    for axis in range(3):
        for side, sign in ((0, -1.0), (1, 1.0)):
            beyond = sign * (mesh.vertices[:, axis] - bounds[side, axis])
            # A face that merely touches the side from beyond is none of the part, though its corners there are.
            mesh = used(mesh, mesh.faces[(beyond[mesh.faces] < -tolerance).any(axis=1)])
            beyond = sign * (mesh.vertices[:, axis] - bounds[side, axis])
            near = beyond <= tolerance
            if not near.all():
                mesh = cut_along(mesh, near, beyond, 0.0)
    return mesh
