"""Which normals of a cloud are kept, and which are estimated or turned around, as was asked."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.normals import Orientation, flip_if_inward, oriented_normals
from gnrecon.runtime.errors import UsageError

MODES = {
    "auto": "estimated where there are none; all turned around where they look into a closed surface",
    "given": "estimated where there are none, and otherwise taken as they are",
    "signs": "their directions kept, and the side of each found anew",
    "estimate": "estimated anew",
}
"""What `with_outward_normals` does with normals."""


def require_orientation(mode: str) -> None:
    """Refuse a mode that is not known.

    Raises
    ------
    UsageError
    """
    if mode not in MODES:
        raise UsageError(f"Normals can be oriented by {', '.join(MODES)}, not {mode!r}.")


def with_outward_normals(cloud: PointCloud, mode: str) -> tuple[PointCloud, Orientation]:
    """Return the cloud with outward unit normals, and how they came about.

    Parameters
    ----------
    cloud : with unit normals or none
    mode : a name of `MODES`

    Raises
    ------
    InputError
        When normals cannot be estimated.
    """
    normals = cloud.normals
    if normals is None or mode == "estimate":
        found = oriented_normals(cloud.points, cloud.origins)
    elif mode == "signs":
        sides = oriented_normals(cloud.points, cloud.origins, along=normals)
        turned = float((np.einsum("ij,ij->i", sides.normals, normals) < 0).mean())
        found = Orientation(sides.normals, "given, sides " + sides.how, sides.confidence, turned)
    else:
        kept, inward = flip_if_inward(cloud.points, normals) if mode == "auto" else (normals, False)
        found = Orientation(kept, "given, flipped" if inward else "given", None, float(inward))
    return cloud.with_normals(found.normals), found
