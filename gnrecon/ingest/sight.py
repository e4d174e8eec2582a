"""Normals that look at the scanner: the side of a surface that was seen is its outside.

Where the line of sight grazes the estimated plane, a small error of the plane would decide the side, and where a
point's origin is not known nothing does. Such points follow the mean normal of the nearest ones that are decided.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Mask

_GRAZING = float(np.sin(np.radians(10.0)))
_NEIGHBOURS = 8
_KNOWN = 0.5
"""Share of the points whose origin must be known for the others to follow them."""


def towards_scanner(points: Float, directions: Float, origins: Float | None) -> tuple[Float, float] | None:
    """Return the directions with the signs that look at the scanner, and the share of points where sight decides.

    Parameters
    ----------
    points, directions : arrays of shape (N, 3); directions of unit length
    origins : array of shape (N, 3), rows of NaN where they are not known; or None

    Returns
    -------
    Normals of shape (N, 3) and a share, or None where too few origins are known.
    """
    if origins is None:
        return None
    sight = origins - points
    lengths = np.linalg.norm(sight, axis=1)
    with np.errstate(invalid="ignore"):
        cosines = np.einsum("ij,ij->i", directions, sight) / np.maximum(lengths, np.finfo(np.float64).tiny)
    known = np.isfinite(cosines) & (lengths > 0)
    decided = known & (np.abs(cosines) >= _GRAZING)
    if known.mean() < _KNOWN or not decided.any():
        return None
    normals: Float = directions * np.where(cosines < 0, -1.0, 1.0)[:, None]
    return _followed(points, normals, decided), float(decided.mean())


def _followed(points: Float, normals: Float, decided: Mask) -> Float:
    """Return the normals, those that are not decided with the sign of the nearest that are."""
    from scipy.spatial import cKDTree

    count = min(_NEIGHBOURS, int(decided.sum()))
    near = cKDTree(points[decided]).query(points[~decided], list(range(1, count + 1)))[1]
    mean = normals[decided][near].sum(axis=1)
    result = normals.copy()
    result[~decided] *= np.where(np.einsum("ij,ij->i", normals[~decided], mean) < 0, -1.0, 1.0)[:, None]
    return result
