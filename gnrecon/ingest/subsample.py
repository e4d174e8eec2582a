"""Thinning a cloud to a number of its own points, attributes included, reproducibly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from gnrecon.cloud import PointCloud
from gnrecon.errors import UsageError
from gnrecon.ingest.poisson_disk import poisson_disk
from gnrecon.ingest.voxel import voxel_representatives

Float = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]


def _random(points: Float, count: int, rng: np.random.Generator) -> Rows:
    return rng.permutation(len(points))[:count]


METHODS: dict[str, Callable[[Float, int, np.random.Generator], Rows]] = {
    "random": _random,
    "voxel": voxel_representatives,
    "poisson": poisson_disk,
}


def subsample(
    cloud: PointCloud,
    *,
    fraction: float | None = None,
    max_points: int | None = None,
    method: str = "random",
    seed: int = 0,
) -> PointCloud:
    """Return some of the cloud's points, in their order in the cloud; all of them when nothing is to be left out.

    Parameters
    ----------
    cloud : its points must be finite and distinct
    fraction : share of the points, in (0, 1]
    max_points : bound on their number, at least 1; with `fraction`, the smaller of both counts
    method : ``"random"``; ``"voxel"`` keeps the point nearest to the mean of each occupied cube; ``"poisson"`` keeps
        points no two of which are closer than a radius, the most even of the three
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
    count = len(cloud) if fraction is None else max(1, round(fraction * len(cloud)))
    count = count if max_points is None else min(count, max_points)
    if count >= len(cloud):
        return cloud
    # About the mean, because differences of far-off coordinates lose digits.
    centred = cloud.points - cloud.points.mean(axis=0)
    return cloud.select(np.sort(METHODS[method](centred, count, np.random.default_rng(seed))))
