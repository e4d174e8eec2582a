"""Dropping what no surface can be fitted to, with a count for each reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.clusters import isolated_clusters
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.outlier_rules import MODES, outliers_by_rule, parse_outliers
from gnrecon.ingest.outliers import find_outliers
from gnrecon.ingest.repeats import repeated_points
from gnrecon.runtime.errors import InputError, UsageError

LEAST_POINTS = 10
_FLAT = 1e-4  # ratio of extents below which a cloud counts as a plane or a line


def clean(
    cloud: PointCloud,
    outliers: str = "auto",
    max_outlier_share: float = 0.05,
    *,
    clusters: str = "auto",
    units: str | None = None,
) -> tuple[PointCloud, IngestCounts]:
    """Return the usable points, with unit normals where the cloud has some, and what was dropped.

    Dropped are points that are not finite, exact duplicates (the first stays), points without a direction where most
    have one (where most have none, all normals are discarded), copies of points in a scan that is there twice, see
    `repeats`, outliers, and isolated clusters, see `clusters`.

    Parameters
    ----------
    outliers : ``"auto"`` drops outliers unless they are more than `max_outlier_share` of the points, which points to a
        property of the scan rather than to stray points; ``"on"`` drops them always, ``"off"`` never;
        ``"statistical:2"`` and ``"radius:3s,4"`` drop what other rules call so, see `outlier_rules`
    max_outlier_share : share in [0, 1]
    clusters : ``"auto"``, ``"on"`` or ``"off"``, the same for isolated clusters
    units : the cloud's unit, for a distance in another one

    Raises
    ------
    UsageError
        When an argument is none of those.
    InputError
        When fewer than 10 points remain, or all lie on a line or in a plane.
    """
    rule = parse_outliers(outliers, units)
    require_mode(clusters)
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
    repeated = repeated_points(_centred(cloud))
    cloud, counts = cloud.select(~repeated), replace(counts, repeated=int(repeated.sum()))
    if rule.name in MODES:
        cloud, dropped, left = _without(cloud, find_outliers(_centred(cloud)), rule.name, max_outlier_share)
    else:
        cloud, dropped, left = _without(cloud, outliers_by_rule(_centred(cloud), rule, units), "on", 1.0)
    counts = replace(counts, outliers=dropped, outliers_found=left)
    _require(cloud, counts)
    cloud, dropped, left = _without(cloud, isolated_clusters(_centred(cloud)), clusters, max_outlier_share)
    counts = replace(counts, clusters=dropped, clusters_found=left)
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


def _centred(cloud: PointCloud) -> Float:
    """The points about their mean, because differences of far-off coordinates lose digits."""
    centred: Float = cloud.points - cloud.points.mean(axis=0)
    return centred


def _without(cloud: PointCloud, mask: Mask, mode: str, max_share: float) -> tuple[PointCloud, int, int]:
    """Drop the points of a mask if the mode allows it; how many were dropped, and how many were left alone."""
    found = int(mask.sum())
    if mode == "on" or (mode == "auto" and found <= max_share * len(cloud)):
        return cloud.select(~mask), found, 0
    return cloud, 0, found


def require_mode(clusters: str) -> None:
    """Refuse what is no mode of dropping isolated clusters.

    Raises
    ------
    UsageError
        With the sentence that says so.
    """
    if clusters not in MODES:
        raise UsageError(f"The mode for isolated clusters is {clusters!r}, but must be one of {', '.join(MODES)}.")


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
