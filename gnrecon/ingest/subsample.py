"""Thinning a cloud to a number of its own points, attributes included, reproducibly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.local_pca import surface_variation
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.noise import mean_spacing
from gnrecon.ingest.voxel_grid import voxel_representatives, voxel_representatives_of_side
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import UsageError


def _random(points: Float, count: int, rng: np.random.Generator) -> Int:
    return rng.permutation(len(points))[:count]


# Curvature-aware thinning: half of the points evenly, half where the surface bends, without clumps.
#
# How much the surface bends at a point is told by the surface variation of its neighbours, the share of the smallest
# eigenvalue in their covariance (Pauly, Gross and Kobbelt 2002). Each point's chance to stay is a constant plus a
# multiple of that. Points are put in the order of a curve that fills space (Morton's), and chosen systematically along
# it: at equal steps of the summed chances, so that neighbours are hardly ever chosen or left out together.


def by_curvature(points: Float, count: int, rng: np.random.Generator) -> Int:
    """Return `count` row indices, more of them where the surface bends.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= count >= 1
    """
    bend = pointwise_surface_variation(points)
    weights = np.full(len(points), _EVENLY / len(points))
    weights += (1 - _EVENLY) * (bend / bend.sum() if bend.sum() > 0 else 1 / len(points))
    order = _along_curve(points)
    summed = np.cumsum(_chances(weights, count)[order])
    steps = np.floor(summed * (count / summed[-1]) - rng.random())
    return order[np.flatnonzero(np.diff(steps, prepend=-1.0) > 0)][:count]


# Farthest-point thinning: each further point is the one that lies farthest from all that were taken, by fpsample.
#
# It is the greedy 2-approximation of the k-centre problem (Gonzalez 1985), and reaches into every corner of a cloud.
# The library buckets the points in a tree, so that a step looks at a few of them only (Han et al., QuickFPS, 2023).


def farthest_points(points: Float, count: int, rng: np.random.Generator) -> Int:
    """Return `count` row indices, beginning with a random one.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= count >= 1
    """
    import fpsample

    first = int(rng.integers(len(points)))
    # Scaled, because the library works in single precision.
    scaled = (points / np.abs(points).max()).astype(np.float32)
    height = min(_SMALL if len(points) < 10_000 else _LARGE, len(points).bit_length() - 1)
    chosen: Int = fpsample.bucket_fps_kdline_sampling(scaled, count, height, first).astype(np.intp)
    return chosen


# Poisson-disk thinning: real points no two of which are closer than a radius.
#
# In a random order each point stays unless an earlier one within the radius stays. This is resolved for all points at
# once, in rounds: whoever has no undecided earlier neighbour stays and strikes out its neighbours. The radius is
# searched by bisection for the wanted count. Common libraries' versions are unseeded or work in single precision.


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


METHODS: dict[str, Callable[[Float, int, np.random.Generator], Int]] = {
    "random": _random,
    "voxel": voxel_representatives,
    "poisson": poisson_disk,
    "farthest": farthest_points,
    "curvature": by_curvature,
}


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


BY_DISTANCE: dict[str, Callable[[Float, float, np.random.Generator], Int]] = {
    "voxel": voxel_representatives_of_side,
    "poisson": poisson_disk_apart,
}
"""Methods that a distance between points decides by itself."""


def subsample(
    cloud: PointCloud,
    *,
    fraction: float | None = None,
    max_points: int | None = None,
    spacing: float | None = None,
    method: str = "random",
    seed: int = 0,
) -> PointCloud:
    """Return some of the cloud's points, in their order in the cloud; all of them when nothing is to be left out.

    Parameters
    ----------
    cloud : its points must be finite and distinct
    fraction : share of the points, in (0, 1]
    max_points : bound on their number, at least 1; with `fraction`, the smaller of both counts
    spacing : distance between neighbouring points that is wanted, in the cloud's unit: the cubes' side of ``"voxel"``
        and the least distance of ``"poisson"``; of the others as many points are kept as have that spacing on a surface
    method : ``"random"``; ``"voxel"`` keeps the point nearest to the mean of each occupied cube; ``"poisson"`` keeps
        points no two of which are closer than a radius, the most even of all; ``"farthest"`` takes again and again the
        point that is farthest from those taken; ``"curvature"`` keeps more where the surface bends
    seed : a number from 0; the same one gives the same points

    Raises
    ------
    UsageError
        When an argument is out of its range.
    """
    if fraction is not None and not 0 < fraction <= 1:
        raise UsageError(f"The fraction of points is {fraction}, but must lie in (0, 1].")
    if max_points is not None and max_points < 1:
        raise UsageError(f"The largest number of points is {max_points}, but must be at least 1.")
    if method not in METHODS:
        raise UsageError(f"The subsampling method {method!r} is unknown; expected one of {', '.join(METHODS)}.")
    if spacing is not None and not 0 < spacing < np.inf:
        raise UsageError(f"The spacing of the points is {spacing:g}, but must be a positive length.")
    if spacing is not None:
        cloud = _apart(cloud, spacing, method, seed)
    count = len(cloud) if fraction is None else max(1, round(fraction * len(cloud)))
    count = count if max_points is None else min(count, max_points)
    return _chosen(cloud, count, method, seed)


def _apart(cloud: PointCloud, spacing: float, method: str, seed: int) -> PointCloud:
    if method in BY_DISTANCE:
        centred = cloud.points - cloud.points.mean(axis=0)
        return cloud.select(np.sort(BY_DISTANCE[method](centred, spacing, np.random.default_rng(seed))))
    # On a surface, the number of points falls with the square of their distance.
    share = min(1.0, (mean_spacing(cloud.points) / spacing) ** 2)
    return _chosen(cloud, max(1, round(share * len(cloud))), method, seed)


def _chosen(cloud: PointCloud, count: int, method: str, seed: int) -> PointCloud:
    if count >= len(cloud):
        return cloud
    # About the mean, because differences of far-off coordinates lose digits.
    centred = cloud.points - cloud.points.mean(axis=0)
    return cloud.select(np.sort(METHODS[method](centred, count, np.random.default_rng(seed))))


_CANDIDATES = 8  # times the wanted count; more hardly evens the result out, and the neighbour pairs grow with it

_TOLERANCE = 0.02  # of the count, within which the search stops

_GROWTH = 1.2

_BISECTIONS = 16


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


_SMALL, _LARGE = 3, 7
"""Heights of the tree that suit fewer than 10,000 points, and more."""

_NEIGHBOURS = 16

_EVENLY = 0.5
"""Share of the points that are chosen wherever the surface is."""

_AT_A_TIME = 50_000

_BITS = 20


def pointwise_surface_variation(points: Float) -> Float:
    """Return the smallest eigenvalue's share in the covariance of each point's neighbourhood, of shape (N,)."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    found = np.zeros(len(points))
    for some in slices(len(points), _AT_A_TIME):
        rows = tree.query(points[some], min(_NEIGHBOURS, len(points)))[1]
        found[some] = surface_variation(points[rows.reshape(len(rows), -1)])
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
