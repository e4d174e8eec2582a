"""Thinning a cloud to a number of its own points, attributes included, reproducibly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.by_curvature import by_curvature
from gnrecon.ingest.farthest import farthest_points
from gnrecon.ingest.poisson_disk import poisson_disk, poisson_disk_apart
from gnrecon.ingest.spacing import mean_spacing
from gnrecon.ingest.voxel import voxel_representatives, voxel_representatives_of_side
from gnrecon.runtime.errors import UsageError


def _random(points: Float, count: int, rng: np.random.Generator) -> Int:
    return rng.permutation(len(points))[:count]


METHODS: dict[str, Callable[[Float, int, np.random.Generator], Int]] = {
    "random": _random,
    "voxel": voxel_representatives,
    "poisson": poisson_disk,
    "farthest": farthest_points,
    "curvature": by_curvature,
}

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
