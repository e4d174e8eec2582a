"""Curvature-aware thinning: half of the points evenly, half where the surface bends, without clumps.

How much the surface bends at a point is told by the surface variation of its neighbours, the share of the smallest
eigenvalue in their covariance (Pauly, Gross and Kobbelt 2002). Each point's chance to stay is a constant plus a
multiple of that. Points are put in the order of a curve that fills space (Morton's), and chosen systematically along
it: at equal steps of the summed chances, so that neighbours are hardly ever chosen or left out together.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Int
from gnrecon.ingest.outliers import thickness
from gnrecon.runtime.parallel import slices

_NEIGHBOURS = 16
_EVENLY = 0.5
"""Share of the points that are chosen wherever the surface is."""

_AT_A_TIME = 50_000
_BITS = 20


def by_curvature(points: Float, count: int, rng: np.random.Generator) -> Int:
    """Return `count` row indices, more of them where the surface bends.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= count >= 1
    """
    bend = surface_variation(points)
    weights = np.full(len(points), _EVENLY / len(points))
    weights += (1 - _EVENLY) * (bend / bend.sum() if bend.sum() > 0 else 1 / len(points))
    order = _along_curve(points)
    summed = np.cumsum(_chances(weights, count)[order])
    steps = np.floor(summed * (count / summed[-1]) - rng.random())
    return order[np.flatnonzero(np.diff(steps, prepend=-1.0) > 0)][:count]


def surface_variation(points: Float) -> Float:
    """Return the smallest eigenvalue's share in the covariance of each point's neighbourhood, of shape (N,)."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    found = np.zeros(len(points))
    for some in slices(len(points), _AT_A_TIME):
        rows = tree.query(points[some], min(_NEIGHBOURS, len(points)))[1]
        found[some] = thickness(points[rows.reshape(len(rows), -1)])
    return found


def _chances(weights: Float, count: int) -> Float:
    """Chances in proportion to the weights whose sum is `count`, none above 1."""
    chances = np.zeros(len(weights))
    certain = np.zeros(len(weights), bool)
    while True:
        rest = weights[~certain]
        chances[certain], chances[~certain] = 1.0, rest * ((count - certain.sum()) / max(rest.sum(), 1e-300))
        beyond = chances > 1
        if not beyond.any():
            return chances
        certain |= beyond


def _along_curve(points: Float) -> Int:
    """The rows in the order of Morton's curve: by their cell numbers with the bits of x, y and z interleaved."""
    lower = points.min(axis=0)
    cells = ((points - lower) / max(float(np.ptp(points, axis=0).max()), 1e-300) * (2**_BITS - 1)).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            key |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")
