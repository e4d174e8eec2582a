"""Poisson-disk thinning: real points no two of which are closer than a radius.

In a random order each point stays unless an earlier one within the radius stays. This is resolved for all points at
once, in rounds: whoever has no undecided earlier neighbour stays and strikes out its neighbours. The radius is searched
by bisection for the wanted count. Common libraries' versions are unseeded or work in single precision.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Int

_CANDIDATES = 8  # times the wanted count; more hardly evens the result out, and the neighbour pairs grow with it
_TOLERANCE = 0.02  # of the count, within which the search stops
_GROWTH = 1.2
_BISECTIONS = 16


def poisson_disk(points: Float, count: int, rng: np.random.Generator) -> Int:
    """Return `count` row indices of evenly spread points.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= count >= 1
    """
    order = rng.permutation(len(points))[: _CANDIDATES * count]
    tree = cKDTree(points[order])
    low, high = _bracket(tree, count)
    kept = _spread(tree, low)
    for _ in range(_BISECTIONS):
        if len(kept) <= (1 + _TOLERANCE) * count:
            break
        middle = (low + high) / 2
        fewer = _spread(tree, middle)
        if len(fewer) >= count:
            low, kept = middle, fewer
        else:
            high = middle
    chosen: Int = order[rng.permutation(kept)[:count]]
    return chosen


def poisson_disk_apart(points: Float, distance: float, rng: np.random.Generator) -> Int:
    """Return row indices of points no two of which are closer than a distance, such that no other point can be added.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    distance : positive
    """
    order = rng.permutation(len(points))
    tree = cKDTree(points[order])
    chosen: Int = order[_spread_in_turn(tree, distance)]
    return chosen


def _spread_in_turn(tree: cKDTree, radius: float) -> Int:
    """What `_spread` returns, point by point: a wide radius has more pairs than memory can hold."""
    free = np.ones(tree.n, bool)
    kept = []
    for row in range(tree.n):
        if free[row]:
            kept.append(row)
            free[tree.query_ball_point(tree.data[row], radius)] = False
    return np.array(kept, dtype=np.intp)


def _bracket(tree: cKDTree, count: int) -> tuple[float, float]:
    """Return a radius that keeps at least `count` points, and a larger one that keeps fewer."""
    if count == 1:
        return 0.0, 0.0
    spacing = float(np.median(tree.query(tree.data, 2)[0][:, 1]))
    # Random points of density d lie 0.5 / sqrt(d) apart on the mean, a disk pattern's about 0.75 / sqrt(d).
    radius = 1.5 * spacing * float(np.sqrt(tree.n / count))
    if len(_spread(tree, radius)) >= count:
        while len(_spread(tree, _GROWTH * radius)) >= count:
            radius *= _GROWTH
        return radius, _GROWTH * radius
    while len(_spread(tree, radius / _GROWTH)) < count:
        radius /= _GROWTH
    return radius / _GROWTH, radius


def _spread(tree: cKDTree, radius: float) -> Int:
    """Return the points that stay when earlier ones win against later ones within the radius."""
    pairs = tree.query_pairs(radius, output_type="ndarray")  # rows i < j
    stays = np.zeros(tree.n, bool)
    undecided = np.ones(tree.n, bool)
    while undecided.any():
        first = undecided.copy()
        first[pairs[:, 1]] = False
        stays |= first
        struck = np.zeros(tree.n, bool)
        struck[pairs[first[pairs[:, 0]], 1]] = True
        undecided &= ~(first | struck)
        pairs = pairs[undecided[pairs].all(axis=1)]
    return np.flatnonzero(stays)
