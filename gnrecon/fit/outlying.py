"""Points off the surface that a first field tells from the rest: outliers too near to it to be seen by distances alone.

A smooth field leaves something over at every point, because it cannot follow edges and details; but what it leaves over
varies slowly, so that neighbours agree on it. An outlier differs from its neighbours: by much more than points of the
scan do, and by more than they are apart.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.signed_distance import Density

NEIGHBOURS = 8
USUAL, TIMES = 0.95, 4.0
"""How far a point must be off: so many times the difference that this share of all points stays below."""

DISKS = 0.75
"""And so many radii of the disk that it stands for."""

LEAST, MOST = 0.002, 0.04
"""Shares of the points: fewer are chance, or edges, and do no harm; more tell of a field that does not fit."""

LEAST_POINTS = 100


def outlying(value: Float, density: Density) -> Mask:
    """Return which points are off the surface, of shape (N,).

    Parameters
    ----------
    value : array of shape (N,)
        Of a smooth field at the points, unit coordinates.
    density : of the points, unit coordinates
    """
    if len(value) < LEAST_POINTS:
        return np.zeros(len(value), dtype=bool)
    # The first neighbour is the point itself.
    near = density.tree.query(density.points, NEIGHBOURS + 1)[1][:, 1:]
    off = np.abs(value - np.median(value[near], axis=1))
    found: Mask = off > np.maximum(TIMES * np.quantile(off, USUAL), DISKS * density.disks)
    return found if LEAST <= found.mean() <= MOST else np.zeros_like(found)
