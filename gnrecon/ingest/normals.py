"""Outward normals for clouds that come without, and a check of those that come with some.

Directions are the least principal axis of each neighbourhood; what is hard is their sign. Two ways to orient them:

- *propagation* along a minimum spanning tree of nearly parallel tangent planes (Hoppe et al. 1992; open3d): right for
  dense scans, open ones included, but its overall sign is open and thin walls and sparse regions mislead it;
- *Gauss's theorem* solved for all normals at once (`gauss`): right for sparse closed clouds, thin walls included, and
  outward by construction; used on up to a few thousand points, from which the others take their sign.

The winding number of the result (`winding`) fixes the overall sign and decides between them. Propagation gets a second
try with smoother planes where the first leaves doubt.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.errors import InputError
from gnrecon.ingest.gauss import gauss_normals
from gnrecon.ingest.winding import disorder, outwardness

Float = npt.NDArray[np.float64]

_TREE_NEIGHBOURS = 8
_JITTER = 1e-6  # of the extent
_OFF_PLANE_PENALTY = 2.0
_GAUSS_POINTS = 2000
_ORDERLY = 0.25  # disorder above which a closed surface's signs are doubtful in places, or the scan is open
_CLEARLY_BETTER = 0.8  # ratio of disorders that Gauss's theorem must reach against propagation
_OPEN = 0.1  # outwardness, in size, that says nothing about inside and outside
_INWARD = -0.75  # half a sphere with inward normals has about -0.6, and may be the scan of a bowl


def oriented_normals(points: Float, neighbours: int = 12) -> tuple[Float, str]:
    """Estimate unit normals that point outward, for an open sheet mostly upward (+z).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, N >= 10
    neighbours : how many points each tangent plane is fitted to (fewer in clouds of less than a hundred)

    Returns
    -------
    normals : array of shape (N, 3)
    how : ``"estimated"``, or ``"estimated, orientation uncertain"`` where the winding number is far from that of
        a closed surface

    Raises
    ------
    InputError
        When the points cannot be triangulated, as fewer than four.
    """
    centred = points - points.mean(axis=0)
    directions = _tangent_planes(centred, neighbours)
    normals, unrest = _propagated(centred, directions, directions, 0.0)
    if len(points) <= _GAUSS_POINTS or unrest > _ORDERLY:
        smooth = _tangent_planes(centred, 2 * neighbours)
        second, other = _propagated(centred, directions, smooth, _OFF_PLANE_PENALTY)
        if other < unrest:
            normals, unrest = second, other
        third = _by_gauss(centred, directions)
        other = disorder(centred, third)
        # An open scan stays disorderly either way, and there only propagation can be right.
        if other < min(_ORDERLY, _CLEARLY_BETTER * unrest):
            normals, unrest = third, other
    return normals, "estimated" if unrest <= _ORDERLY else "estimated, orientation uncertain"


def _tangent_planes(points: Float, neighbours: int) -> Float:
    """Return unit normals of arbitrary sign, of shape (N, 3)."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    # A tangent plane is local: in the smallest clouds it must not span half of the surface.
    local = min(neighbours, max(4, len(points) // 8))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(local))
    return np.array(cloud.normals)


def _propagated(points: Float, directions: Float, planes: Float, penalty: float) -> tuple[Float, float]:
    """Return `directions` with signs propagated along `planes`, outward or upward as a whole, and their disorder.

    Parameters
    ----------
    points, directions, planes : arrays of shape (N, 3)
    penalty : weight against edges of the tree that leave the tangent plane, as where two sheets come close
    """
    import open3d

    # The tree comes from a Delaunay triangulation, which fails for exactly cospherical points, so all are moved a bit.
    jitter = _JITTER * np.abs(points).max() * np.random.default_rng(0).normal(size=points.shape)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points + jitter))
    cloud.normals = open3d.utility.Vector3dVector(planes)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        try:
            cloud.orient_normals_consistent_tangent_plane(min(_TREE_NEIGHBOURS, len(points) - 1), penalty, 1.0)
        except RuntimeError:  # how open3d reports points that cannot be triangulated
            raise InputError(f"Normals cannot be estimated from {len(points)} points that span no volume.") from None
    signs = np.where(np.einsum("ij,ij->i", directions, np.asarray(cloud.normals)) < 0, -1.0, 1.0)
    normals: Float = directions * signs[:, None]
    side = outwardness(points, normals)
    if abs(side) < _OPEN:
        side = float(normals[:, 2].mean())
    if side < 0:
        normals = -normals
    return normals, disorder(points, normals)


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
