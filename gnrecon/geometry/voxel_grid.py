"""Voxel grid: one point of the cloud for each occupied cube, with the cube's size searched for the wanted count."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Int


def voxel_representatives(
    points: Float, count: int, rng: np.random.Generator, *, bisections: int = 30, tolerance: float = 0.02
) -> Int:
    """Return `count` row indices, each the point nearest to the mean of its cube.

    The cubes are the largest that give at least `count`, and the surplus is cut off at random. Points closer than a
    millionth of the extent always share a cube, so there may be fewer where the cloud is extremely uneven.

    Parameters
    ----------
    points : array of shape (N, 3), distinct, N >= count >= 1
    bisections : most steps of the search for the size: 30 halve the range of its logarithm to rounding
    tolerance : share of surplus cubes at which the search ends
    """
    extent = float(np.ptp(points, axis=0).max())
    low, high = np.log(_finest()), 0.0
    cells = cells_of(points, 0.0)
    for _ in range(bisections):
        middle = (low + high) / 2
        coarser = cells_of(points, extent * float(np.exp(middle)))
        if coarser.max() + 1 >= count:
            low, cells = middle, coarser
        else:
            high = middle
        if cells.max() + 1 <= (1 + tolerance) * count:
            break
    return rng.permutation(_nearest_to_means(points, cells))[:count]


def voxel_representatives_of_side(points: Float, side: float, rng: np.random.Generator) -> Int:
    """Return a row index for each occupied cube of the given side, the point nearest to the mean of those in it.

    Parameters
    ----------
    points : array of shape (N, 3), distinct
    side : positive; below a millionth of the extent, cubes of that size are taken
    """
    del rng  # the result is not random
    return _nearest_to_means(points, cells_of(points, side))


def cells_of(points: Float, size: float) -> Int:
    """Return for each point the number, from 0, of the occupied cube of side `size` that holds it; shape (N,).

    Cubes are no smaller than a millionth of the extent.
    """
    size = max(size, float(np.ptp(points, axis=0).max()) * _finest())
    corner = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    sides = corner.max(axis=0) + 1
    key = (corner[:, 0] * sides[1] + corner[:, 1]) * sides[2] + corner[:, 2]
    cells: Int = np.unique(key, return_inverse=True)[1]
    return cells


def _finest() -> float:
    """Return the least side of cubes, as a share of the extent: three cell numbers then fit into one 64-bit key."""
    return 2.0**-20


def _nearest_to_means(points: Float, cells: Int) -> Int:
    """Return for each cube the row of the point nearest to the mean of the cube's points."""
    sizes = np.bincount(cells)
    means = np.column_stack([np.bincount(cells, weights=points[:, axis]) / sizes for axis in range(3)])
    distances = np.linalg.norm(points - means[cells], axis=1)
    order = np.lexsort((distances, cells))
    nearest: Int = order[np.cumsum(sizes) - sizes]
    return nearest
