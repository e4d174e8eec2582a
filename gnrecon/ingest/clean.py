"""Dropping what no surface can be fitted to, with a count for each reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gnrecon.cloud import PointCloud
from gnrecon.errors import InputError, UsageError
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.outliers import find_outliers

Float = npt.NDArray[np.float64]

LEAST_POINTS = 10
_FLAT = 1e-4  # ratio of extents below which a cloud counts as a plane or a line
_OUTLIERS = ("auto", "on", "off")


def clean(
    cloud: PointCloud, outliers: str = "auto", max_outlier_share: float = 0.05
) -> tuple[PointCloud, IngestCounts]:
    """Return the usable points, with unit normals where the cloud has some, and what was dropped.

    Dropped are points that are not finite, exact duplicates (the first stays), points without a direction where most
    have one (where most have none, all normals are discarded), and outliers.

    Parameters
    ----------
    outliers : ``"auto"`` drops outliers unless they are more than `max_outlier_share` of the points, which points to a
        property of the scan rather than to stray points; ``"on"`` drops them always, ``"off"`` never
    max_outlier_share : share in [0, 1]

    Raises
    ------
    UsageError
        When an argument is none of those.
    InputError
        When fewer than 10 points remain, or all lie on a line or in a plane.
    """
    if outliers not in _OUTLIERS:
        raise UsageError(f"The outlier mode {outliers!r} is unknown; expected one of {', '.join(_OUTLIERS)}.")
    if not 0 <= max_outlier_share <= 1:
        raise UsageError(f"The largest share of outliers is {max_outlier_share}, but must lie in [0, 1].")
    counts = IngestCounts(read=len(cloud))
    finite = np.asarray(np.isfinite(cloud.points).all(axis=1), dtype=bool)
    cloud, counts = cloud.select(finite), replace(counts, non_finite=int((~finite).sum()))
    cloud, dropped = _with_directions(cloud)
    _, first = np.unique(cloud.points, axis=0, return_index=True)
    counts = replace(counts, zero_normals=dropped, duplicates=len(cloud) - len(first))
    cloud = cloud.select(np.sort(first))
    _require(cloud, counts)
    cloud, counts = _without_outliers(cloud, counts, outliers, max_outlier_share)
    _require(cloud, counts)
    _require_volume(cloud.points)
    return cloud, replace(counts, kept=len(cloud), normals="missing" if cloud.normals is None else "given")


def _with_directions(cloud: PointCloud) -> tuple[PointCloud, int]:
    """Return the points with unit normals and how many had none, or all points without normals."""
    if cloud.normals is None:
        return cloud, 0
    # Scaled by the largest component first, so that neither tiny nor huge normals lose their length.
    largest = np.abs(cloud.normals).max(axis=1, initial=0.0)
    usable = np.isfinite(largest) & (largest > 0)
    if 2 * usable.sum() < len(cloud):
        return cloud.with_normals(None), 0
    kept = cloud.select(usable)
    scaled = cloud.normals[usable] / largest[usable, None]
    return kept.with_normals(scaled / np.linalg.norm(scaled, axis=1, keepdims=True)), int((~usable).sum())


def _without_outliers(
    cloud: PointCloud, counts: IngestCounts, mode: str, max_share: float
) -> tuple[PointCloud, IngestCounts]:
    # About the mean, because differences of far-off coordinates lose digits.
    mask = find_outliers(cloud.points - cloud.points.mean(axis=0))
    found = int(mask.sum())
    if mode == "on" or (mode == "auto" and found <= max_share * len(cloud)):
        return cloud.select(~mask), replace(counts, outliers=found)
    return cloud, replace(counts, outliers_found=found)


def _require(cloud: PointCloud, counts: IngestCounts) -> None:
    if len(cloud) < LEAST_POINTS:
        raise InputError(
            f"Only {len(cloud)} of {counts.read} points are usable, but a surface needs at least {LEAST_POINTS}."
        )


def _require_volume(points: Float) -> None:
    """Refuse points that span no volume, since no closed surface is defined by them."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[1] < _FLAT * extents[0]:
        raise InputError("All points lie on one line, so they enclose no volume.")
    if extents[2] < _FLAT * extents[0]:
        raise InputError("All points lie in one plane, so they enclose no volume.")
