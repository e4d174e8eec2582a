"""How outward a set of oriented points is, by their winding number.

By Gauss's theorem the flux w(q) = sum_j a_j n_j . (p_j - q) / (4 pi |p_j - q|^3), with a_j the area that point j
stands for, is 1 inside and 0 outside of a closed surface with outward normals, and 1/2 on it when the singular own term
is left out. Inward normals give -1/2, a flat sheet 0, half of a sphere 1/4. So the median of 2 w over the points tells
outward from inward and says how far the evidence goes: it is near 1 in size only for a surface that is nearly closed.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float

_NEIGHBOURS = 8
_SOURCES = 4000
_QUERIES = 400


def winding_on_surface(points: Float, normals: Float) -> Float:
    """Return the principal value of the winding number at some of the points, of shape (Q,).

    Parameters
    ----------
    points : array of shape (N, 3), centred, all distinct, N > 1
    normals : array of shape (N, 3), of unit length
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(points))[:_SOURCES]
    sources, directions = points[chosen], normals[chosen]
    k = min(_NEIGHBOURS, len(sources) - 1)
    # k neighbours cover a disk that reaches the k-th of them.
    reach = cKDTree(sources).query(sources, k + 1)[0][:, -1]
    weighted = directions * (np.pi * reach**2 / k)[:, None]
    offsets = sources[None, :, :] - sources[:_QUERIES, None, :]
    cubes = np.linalg.norm(offsets, axis=2) ** 3
    cubes[cubes == 0] = np.inf  # a point's own term
    flux: Float = np.einsum("qjc,jc->qj", offsets, weighted)
    winding: Float = (flux / (4 * np.pi * cubes)).sum(axis=1)
    return winding


def outwardness(points: Float, normals: Float) -> float:
    """Return 1 for a closed surface with outward normals, -1 with inward ones, less in size the more it is open."""
    # The median, because where sheets nearly touch single points see each other's singularity.
    return 2 * float(np.median(winding_on_surface(points, normals)))


def disorder(points: Float, normals: Float) -> float:
    """Return the mean distance of the winding number from 1/2: near 0 only for a consistent outward orientation."""
    return float(np.minimum(np.abs(winding_on_surface(points, normals) - 0.5), 1.0).mean())


def agreement(points: Float, normals: Float) -> float:
    """Return the share of the points, in [0, 1], at which the winding number is nearer to 1/2 than to 0 and to 1."""
    return float((np.abs(winding_on_surface(points, normals) - 0.5) < 0.25).mean())
