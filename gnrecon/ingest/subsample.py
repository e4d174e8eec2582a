"""Thinning: chooses a number of a cloud's own points, reproducibly, by one of five methods."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.local_pca import surface_variation
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.geometry.voxel_grid import voxel_representatives, voxel_representatives_of_side
from gnrecon.ingest.point_spacing import mean_spacing
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import UsageError


def _random(points: Float, count: int, rng: np.random.Generator) -> Int:
    return rng.permutation(len(points))[:count]


# Curvature-aware thinning: half of the points evenly, half where the surface bends, without clumps.
#
# Curvature is measured by the surface variation of a point's neighbours (Pauly, Gross and Kobbelt 2002). A point's
# probability is a constant plus a multiple of it. Points are sorted along Morton's space-filling curve and sampled
# systematically, at equal steps of the cumulative probability, so that neighbours are rarely both kept or both dropped.


def by_curvature(points: Float, count: int, rng: np.random.Generator, *, even_share: float = 0.5) -> Int:
    """Return `count` row indices, more of them where the surface bends.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= count >= 1
    even_share : of the points that are chosen regardless of curvature, so that flat parts keep enough
    """
    bend = pointwise_surface_variation(points)
    weights = np.full(len(points), even_share / len(points))
    weights += (1 - even_share) * (bend / bend.sum() if bend.sum() > 0 else 1 / len(points))
    order = _along_curve(points)
    summed = np.cumsum(_probabilities(weights, count)[order])
    steps = np.floor(summed * (count / summed[-1]) - rng.random())
    return order[np.flatnonzero(np.diff(steps, prepend=-1.0) > 0)][:count]


def farthest_points(
    points: Float, count: int, rng: np.random.Generator, *, small_tree_height: int = 3, large_tree_height: int = 7
) -> Int:
    """Return `count` row indices by farthest-point sampling: each is the point farthest from all chosen before.

    The first one is random. This is the greedy 2-approximation of the k-centre problem (Gonzalez 1985), and covers
    every corner of a cloud. The implementation, fpsample, buckets the points in a tree, so that a step considers few of
    them (Han et al., *QuickFPS*, 2023).

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= count >= 1
    small_tree_height, large_tree_height : of the tree for fewer than 10,000 points, and for more, as fpsample advises
    """
    import fpsample

    first = int(rng.integers(len(points)))
    # Scaled, because fpsample works in single precision.
    scaled = (points / np.abs(points).max()).astype(np.float32)
    height = small_tree_height if len(points) < 10_000 else large_tree_height
    height = min(height, len(points).bit_length() - 1)
    chosen: Int = fpsample.bucket_fps_kdline_sampling(scaled, count, height, first).astype(np.intp)
    return chosen


# Poisson-disk thinning: no two of the chosen points are closer than a radius.
#
# In a random order, each point is kept unless an earlier one within the radius is kept. This is resolved for all points
# at once, in rounds: a point without undecided earlier neighbours is kept, and its neighbours are dropped. The radius
# for the wanted count is found by bisection. Versions in common libraries are unseeded or work in single precision.


def poisson_disk(
    points: Float,
    count: int,
    rng: np.random.Generator,
    *,
    candidates_per_point: int = 8,
    tolerance: float = 0.02,
    bisections: int = 16,
) -> Int:
    """Return `count` row indices of evenly spread points.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= count >= 1
    candidates_per_point : random candidates for each wanted point; more improve the evenness little, and the number of
        neighbour pairs grows with them
    tolerance : share of surplus points at which the search for the radius ends; the surplus is cut off at random
    bisections : most steps of the search
    """
    order = rng.permutation(len(points))[: candidates_per_point * count]
    tree = cKDTree(points[order])
    low, high = _bracket(tree, count)
    kept = _kept(tree, low)
    for _ in range(bisections):
        if len(kept) <= (1 + tolerance) * count:
            break
        middle = (low + high) / 2
        fewer = _kept(tree, middle)
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
    """Return row indices of a maximal set of points no two of which are closer than a distance.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    distance : positive
    """
    order = rng.permutation(len(points))
    tree = cKDTree(points[order])
    chosen: Int = order[_kept_in_sequence(tree, distance)]
    return chosen


BY_DISTANCE: dict[str, Callable[[Float, float, np.random.Generator], Int]] = {
    "voxel": voxel_representatives_of_side,
    "poisson": poisson_disk_apart,
}
"""Methods that take a distance between points instead of their number."""


def subsample(
    cloud: PointCloud,
    *,
    fraction: float | None = None,
    max_points: int | None = None,
    spacing: float | None = None,
    method: str = "random",
    seed: int = 0,
) -> PointCloud:
    """Return some of the cloud's points, in their order in the cloud; all of them where nothing limits them.

    Parameters
    ----------
    cloud : its points must be finite and distinct
    fraction : share of the points, in (0, 1]
    max_points : bound on their number, at least 1; with `fraction`, the smaller of both counts
    spacing : wanted distance between neighbouring points, in the cloud's unit: the side of the cubes of ``"voxel"``,
        the least distance of ``"poisson"``; other methods keep as many points as have that spacing on a surface
    method : ``"random"``; ``"voxel"`` keeps the point nearest to the mean of each occupied cube; ``"poisson"`` keeps
        points no two of which are closer than a radius, and is the most even; ``"farthest"`` repeatedly takes the point
        that is farthest from those taken; ``"curvature"`` keeps more where the surface bends
    seed : non-negative; the same seed gives the same points

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
    share = min(1.0, mean_spacing(cloud.points) / spacing) ** 2
    return _chosen(cloud, max(1, round(share * len(cloud))), method, seed)


def _chosen(cloud: PointCloud, count: int, method: str, seed: int) -> PointCloud:
    if count >= len(cloud):
        return cloud
    # About the mean, because differences of coordinates far from the origin lose digits.
    centred = cloud.points - cloud.points.mean(axis=0)
    return cloud.select(np.sort(METHODS[method](centred, count, np.random.default_rng(seed))))


def _kept_in_sequence(tree: cKDTree, radius: float) -> Int:
    """Return the same as `_kept`, point by point, because a wide radius has more pairs than fit into memory."""
    free = np.ones(tree.n, bool)
    kept = []
    for row in range(tree.n):
        if free[row]:
            kept.append(row)
            free[tree.query_ball_point(tree.data[row], radius)] = False
    return np.array(kept, dtype=np.intp)


def _bracket(tree: cKDTree, count: int, *, growth: float = 1.2) -> tuple[float, float]:
    """Return a radius that keeps at least `count` points, and one larger by the factor `growth` that keeps fewer."""
    if count == 1:
        return 0.0, 0.0
    spacing = float(np.median(tree.query(tree.data, 2)[0][:, 1]))
    # The mean spacing at density d is 0.5 / sqrt(d) for random points, about 0.75 / sqrt(d) for a Poisson-disk pattern.
    radius = 1.5 * spacing * float(np.sqrt(tree.n / count))
    if len(_kept(tree, radius)) >= count:
        while len(_kept(tree, growth * radius)) >= count:
            radius *= growth
        return radius, growth * radius
    while len(_kept(tree, radius / growth)) < count:
        radius /= growth
    return radius / growth, radius


def _kept(tree: cKDTree, radius: float) -> Int:
    """Return the points that are kept where earlier ones have precedence within the radius."""
    pairs = tree.query_pairs(radius, output_type="ndarray")  # rows i < j
    kept = np.zeros(tree.n, bool)
    undecided = np.ones(tree.n, bool)
    while undecided.any():
        first = undecided.copy()
        first[pairs[:, 1]] = False
        kept |= first
        dropped = np.zeros(tree.n, bool)
        dropped[pairs[first[pairs[:, 0]], 1]] = True
        undecided &= ~(first | dropped)
        pairs = pairs[undecided[pairs].all(axis=1)]
    return np.flatnonzero(kept)


def pointwise_surface_variation(points: Float, *, neighbours: int = 16, chunk_points: int = 50_000) -> Float:
    """Return the surface variation of each point's neighbourhood, of shape (N,).

    Parameters
    ----------
    points : array of shape (N, 3)
    neighbours : of a point, itself included
    chunk_points : handled at a time, which bounds memory
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    found = np.zeros(len(points))
    for some in slices(len(points), chunk_points):
        rows = tree.query(points[some], min(neighbours, len(points)))[1]
        found[some] = surface_variation(points[rows.reshape(len(rows), -1)])
    return found


def _probabilities(weights: Float, count: int) -> Float:
    """Return probabilities proportional to the weights, of sum `count`, none above 1."""
    probabilities = np.zeros(len(weights))
    certain = np.zeros(len(weights), bool)
    while True:
        rest = weights[~certain]
        probabilities[certain], probabilities[~certain] = (
            1.0,
            rest * ((count - certain.sum()) / max(rest.sum(), 1e-300)),
        )
        beyond = probabilities > 1
        if not beyond.any():
            return probabilities
        certain |= beyond


def _along_curve(points: Float, *, bits: int = 20) -> Int:
    """Return the rows along Morton's curve: by cell numbers with interleaved bits of x, y and z, 3 x 20 of an int64."""
    lower = points.min(axis=0)
    cells = ((points - lower) / max(float(np.ptp(points, axis=0).max()), 1e-300) * (2**bits - 1)).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(bits):
        for axis in range(3):
            key |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")
