"""Outward normals for clouds that come without, and a check of those that come with some.

Directions are the least principal axis of each neighbourhood; what is hard is their sign. Two ways to orient them:

- *propagation* along a minimum spanning tree of nearly parallel tangent planes (Hoppe et al. 1992; open3d): right for
  dense scans, open ones included, but its overall sign is open and thin walls and sparse regions mislead it;
- *Gauss's theorem* solved for all normals at once (`gauss`): right for sparse closed clouds, thin walls included, and
  outward by construction; used on up to a few thousand points, from which the others take their sign.

The winding number of the result (`winding`) fixes the overall sign and decides between the two.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.errors import InputError
from gnrecon.ingest.gauss import gauss_normals
from gnrecon.ingest.winding import disorder, outwardness

Float = npt.NDArray[np.float64]

_TREE_NEIGHBOURS = 8
_GAUSS_POINTS = 2000
_ORDERLY = 0.25  # disorder below which a dense cloud's propagated signs are taken without a second opinion
_CLEARLY_BETTER = 0.7  # ratio of disorders; open scans never reach it, and there propagation is the right one
_UNCERTAIN = 0.25  # disorder above which the orientation may be wrong in places (or the scan is open)
_OPEN = 0.1  # outwardness, in size, that says nothing about inside and outside
_INWARD = -0.6  # half a sphere with inward normals has -0.5, and may be the scan of a bowl


def oriented_normals(points: Float, neighbours: int = 12) -> tuple[Float, str]:
    """Estimate unit normals that point outward, for an open sheet mostly upward (+z).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, N >= 10
    neighbours : how many points each tangent plane is fitted to

    Returns
    -------
    normals : array of shape (N, 3)
    how : ``"estimated"``, or ``"estimated, orientation uncertain"`` where the winding number is far from that of
        a closed surface

    Raises
    ------
    InputError
        When the points span no volume.
    """
    centred = points - points.mean(axis=0)
    directions, propagated = _propagated(centred, neighbours)
    side = outwardness(centred, propagated)
    if abs(side) < _OPEN:
        side = float(propagated[:, 2].mean())
    normals = -propagated if side < 0 else propagated
    unrest = disorder(centred, normals)
    if len(points) <= _GAUSS_POINTS or unrest > _ORDERLY:
        alternative = _by_gauss(centred, directions)
        other = disorder(centred, alternative)
        if other < _CLEARLY_BETTER * unrest:
            normals, unrest = alternative, other
    return normals, "estimated" if unrest <= _UNCERTAIN else "estimated, orientation uncertain"


def _propagated(points: Float, neighbours: int) -> tuple[Float, Float]:
    """Return the directions before and after propagation of signs, each of shape (N, 3)."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(min(neighbours, len(points))))
        directions = np.array(cloud.normals)
        try:
            cloud.orient_normals_consistent_tangent_plane(min(_TREE_NEIGHBOURS, len(points) - 1))
        except RuntimeError:  # its Delaunay triangulation needs points that span a volume
            raise InputError("Normals cannot be estimated, because the points span no volume.") from None
    return directions, np.array(cloud.normals)


def _by_gauss(points: Float, directions: Float) -> Float:
    """Return unit normals signed by Gauss's theorem; for small clouds its own directions take part."""
    from scipy.spatial import cKDTree

    chosen = np.random.default_rng(0).permutation(len(points))[:_GAUSS_POINTS]
    outward = gauss_normals(points[chosen])
    nearest = cKDTree(points[chosen]).query(points)[1]
    signs = np.where(np.einsum("ij,ij->i", directions, outward[nearest]) < 0, -1.0, 1.0)
    signed: Float = directions * signs[:, None]
    if len(points) > _GAUSS_POINTS:
        return signed
    # Both estimates err, and differently: their mean is closer to the truth than either. They never oppose each other.
    blended = signed + outward[nearest]
    normals: Float = blended / np.linalg.norm(blended, axis=1, keepdims=True)
    return normals


def flip_if_inward(points: Float, normals: Float) -> tuple[Float, bool]:
    """Return the normals, all flipped where they clearly look into a nearly closed surface, and whether they were.

    Parameters
    ----------
    points : array of shape (N, 3), distinct
    normals : array of shape (N, 3), of unit length
    """
    inward = outwardness(points - points.mean(axis=0), normals) < _INWARD
    return (-normals, True) if inward else (normals, False)
