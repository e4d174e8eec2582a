"""Scattered points far off the surface, found by local density and without harm to thinly scanned regions.

With m_i the mean distance of point i to its k nearest neighbours, a global bound on m_i would delete whatever the
scanner saw at a distance or at a grazing angle. Two tests spare it:

- *relative*: log(m_i / median of m over its neighbours) is near 0 in dense and in thin regions alike, and large for a
  point that hangs above a denser sheet. The bound is robust (median and median absolute deviation), never below a
  factor of 3. Removing such points uncovers others, so the test is repeated with the same bound.
- *scattered*: points in whose surroundings there are only other outliers pass the first test, but they fill a volume:
  the covariance of their neighbourhood is thick, whereas a thin scan is still a sheet.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.statistics import deviation

_NEIGHBOURS = 16
_DEVIATIONS = 6.0
_LEAST_FACTOR = 3.0
_PASSES = 8
_SPARSE_FACTOR = 4.0  # times the median spacing, beyond which thickness is looked at
_THICKNESS = 0.08  # smallest eigenvalue's share; about 0.03 at most for a curved sheet, 0.15 for points in a volume


def find_outliers(points: Float) -> Mask:
    """Return the mask, of shape (N,), of scattered points far off the surface.

    Parameters
    ----------
    points : array of shape (N, 3), centred, N > 1
    """
    remaining = np.arange(len(points))
    bound: float | None = None
    for _ in range(_PASSES):
        if len(remaining) <= _NEIGHBOURS:
            break
        spacing, neighbours = _spacing(points[remaining])
        ratio = np.log(spacing / np.median(spacing[neighbours], axis=1))
        if bound is None:
            middle = float(np.median(ratio))
            spread = deviation(ratio - middle)
            bound = max(float(np.log(_LEAST_FACTOR)), middle + _DEVIATIONS * spread)
        far = ratio > bound
        sparse = np.flatnonzero(spacing > _SPARSE_FACTOR * np.median(spacing))
        far[sparse] |= thickness(points[remaining][neighbours[sparse]]) > _THICKNESS
        if not far.any():
            break
        remaining = remaining[~far]
    outliers = np.ones(len(points), bool)
    outliers[remaining] = False
    return outliers


def _spacing(points: Float) -> tuple[Float, Int]:
    """Return the mean distance to the nearest neighbours, of shape (N,), and their indices, of shape (N, k)."""
    from scipy.spatial import cKDTree

    distances, neighbours = cKDTree(points).query(points, _NEIGHBOURS + 1)
    # Distinct points may lie so close that a distance underflows; the logarithm needs a positive one.
    return np.maximum(distances[:, 1:].mean(axis=1), np.finfo(np.float64).tiny), neighbours[:, 1:]


def thickness(groups: Float) -> Float:
    """Return the smallest eigenvalue's share of each group's covariance, of shape (G,); `groups` has shape (G, k, 3).

    It is 0 where all points of a group coincide.
    """
    centred = groups - groups.mean(axis=1, keepdims=True)
    eigenvalues = np.linalg.eigvalsh(np.einsum("gki,gkj->gij", centred, centred))
    sums = eigenvalues.sum(axis=1)
    shares: Float = np.maximum(eigenvalues[:, 0], 0) / np.where(sums > 0, sums, 1)
    return shares
