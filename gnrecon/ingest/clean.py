"""Cleaning: drops points that a surface cannot be fitted to, with a count for each reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.ingest_parameters import IngestParameters
from gnrecon.ingest.isolated_clusters import isolated_clusters
from gnrecon.ingest.outliers import REMOVAL_MODES, find_outliers, outliers_by_rule, parse_outliers
from gnrecon.ingest.repeated_points import repeated_points
from gnrecon.runtime.errors import InputError, UsageError


def clean(
    cloud: PointCloud,
    outliers: str = "auto",
    max_outlier_share: float = 0.05,
    *,
    clusters: str = "auto",
    units: str | None = None,
    parameters: IngestParameters = IngestParameters(),
) -> tuple[PointCloud, IngestCounts]:
    """Return the usable points, with unit normals where the cloud has some, and the numbers of dropped points.

    Dropped are points that are not finite or out of all proportion, see `usable_positions`, exact duplicates (the first
    is kept), points without a normal where most have one (where most have none, all normals are discarded), copies of
    points where a scan is contained twice, see `repeated_points`, outliers, and isolated clusters, see
    `isolated_clusters`.

    Parameters
    ----------
    outliers : ``"auto"`` drops outliers unless they are more than `max_outlier_share` of the points, which indicates a
        property of the scan rather than stray points; ``"on"`` always drops them, ``"off"`` never;
        ``"statistical:2"`` and ``"radius:3s,4"`` drop those of other rules, see `parse_outliers`
    max_outlier_share : share in [0, 1]
    clusters : ``"auto"``, ``"on"`` or ``"off"``, the same for isolated clusters
    units : the cloud's unit, for a distance in another one
    parameters : tuning constants

    Raises
    ------
    UsageError
        When an argument is out of its range.
    InputError
        When fewer than 10 points remain, all lie on a line or in a plane, or they extend too far or not far enough.
    """
    rule = parse_outliers(outliers, units)
    require_mode(clusters)
    if not 0 <= max_outlier_share <= 1:
        raise UsageError(f"The largest share of outliers is {max_outlier_share}, but must lie in [0, 1].")
    counts = IngestCounts(read=len(cloud))
    finite = usable_positions(cloud.points)
    cloud, counts = cloud.select(finite), replace(counts, non_finite=int((~finite).sum()))
    cloud, dropped = _with_unit_normals(cloud)
    first = distinct_positions(cloud.points)
    counts = replace(counts, zero_normals=dropped, duplicates=len(cloud) - len(first))
    cloud = cloud.select(np.sort(first))
    _require_points(cloud, counts, parameters.least_points)
    repeated = repeated_points(_centred(cloud))
    cloud, counts = cloud.select(~repeated), replace(counts, repeated=int(repeated.sum()))
    if rule.name in REMOVAL_MODES:
        found = find_outliers(_centred(cloud), parameters=parameters.outliers)
        cloud, dropped, kept = _remove(cloud, found, rule.name, max_outlier_share)
    else:
        cloud, dropped, kept = _remove(cloud, outliers_by_rule(_centred(cloud), rule, units), "on", 1.0)
    counts = replace(counts, outliers=dropped, outliers_found=kept)
    _require_points(cloud, counts, parameters.least_points)
    found = isolated_clusters(_centred(cloud), parameters=parameters.clusters)
    cloud, dropped, kept = _remove(cloud, found, clusters, max_outlier_share)
    counts = replace(counts, clusters=dropped, clusters_found=kept)
    _require_points(cloud, counts, parameters.least_points)
    _require_volume(cloud.points)
    return cloud, replace(counts, kept=len(cloud), normals="missing" if cloud.normals is None else "given")


def usable_positions(
    points: Float, *, most_spreads: float = 1e9, least_spread: float = 1e-15, most_spread: float = 1e15
) -> Mask:
    """Return the mask, of shape (N,), of points whose coordinates are numbers that can be computed with.

    Others are not finite, or come from damaged bytes: next to a point at 1e38, float64 cannot tell the others apart,
    and squares overflow.

    Parameters
    ----------
    points : array of shape (N, 3), file units
    most_spreads : largest distance from the median, in medians of this distance; float64 resolves 1e-16 of it
    least_spread, most_spread : range of the median distance, in file units, wide enough for atoms in metres and stars
        in kilometres; the sixth powers of lengths stay far from the limits of float64

    Raises
    ------
    InputError
        When the median distance lies outside this range.
    """
    usable = np.asarray(np.isfinite(points).all(axis=1), dtype=bool)
    if not usable.any():
        return usable
    # A quarter of the coordinates, so that no sum or difference of two of them overflows.
    quarters = points[usable] / 4
    away = np.abs(quarters - np.median(quarters, axis=0)).max(axis=1)
    # Points at the same position, such as pulses without an echo, must not make the spread zero.
    apart = away[away > 0]
    if not len(apart):
        return usable
    spread = 4 * min(float(np.median(apart)), most_spread)
    if not least_spread < spread < most_spread:
        extent = f"less than {least_spread:g}" if spread <= least_spread else f"more than {most_spread:g}"
        raise InputError(f"The points extend over {extent} file units, which cannot be computed with; scale the scan.")
    with np.errstate(over="ignore"):  # what overflows is out of all proportion
        usable[usable] = away / spread <= most_spreads / 4
    return usable


def without_garbage(cloud: PointCloud) -> PointCloud:
    """Return the points that can be computed with: next to others, distances between them vanish.

    It is the cloud itself where all can; errors are those of `usable_positions`.
    """
    usable = usable_positions(cloud.points)
    return cloud if usable.all() else cloud.select(usable)


def distinct_positions(points: Float) -> Int:
    """Return the first row, of shape (M,), of each position of finite points, of shape (N, 3); sorted by position.

    Positions count relative to the mean, as in all that follows: what coincides there is one position.
    """
    middle = points.mean(axis=0) if len(points) else 0.0
    first: Int = np.unique(points - middle, axis=0, return_index=True)[1]
    return first


def _with_unit_normals(cloud: PointCloud) -> tuple[PointCloud, int]:
    """Return the points that have a normal, of unit length, and the number of others; or all points without normals."""
    if cloud.normals is None:
        return cloud, 0
    usable, directions = unit_normals(cloud.normals)
    if 2 * usable.sum() < len(cloud):
        return cloud.with_normals(None), 0
    return cloud.select(usable).with_normals(directions), int((~usable).sum())


def unit_normals(normals: Float) -> tuple[Mask, Float]:
    """Return which normals, of shape (N, 3), are neither zero nor broken, and these at unit length, of shape (M, 3)."""
    # Scaled by the largest component first, so that squares of tiny or huge normals do not under- or overflow.
    largest = np.abs(normals).max(axis=1, initial=0.0)
    usable = np.isfinite(largest) & (largest > 0)
    scaled = normals[usable] / largest[usable, None]
    return usable, scaled / np.linalg.norm(scaled, axis=1, keepdims=True)


def _centred(cloud: PointCloud) -> Float:
    """Return the points about their mean, because differences of coordinates far from the origin lose digits."""
    centred: Float = cloud.points - cloud.points.mean(axis=0)
    return centred


def _remove(cloud: PointCloud, mask: Mask, mode: str, max_share: float) -> tuple[PointCloud, int, int]:
    """Drop the points of a mask if the mode allows it; also return the numbers of points dropped and kept."""
    found = int(mask.sum())
    if mode == "on" or (mode == "auto" and found <= max_share * len(cloud)):
        return cloud.select(~mask), found, 0
    return cloud, 0, found


def require_mode(clusters: str) -> None:
    """Check the mode for isolated clusters.

    Raises
    ------
    UsageError
        When it is not one of `REMOVAL_MODES`.
    """
    if clusters not in REMOVAL_MODES:
        raise UsageError(
            f"The mode for isolated clusters is {clusters!r}, but must be one of {', '.join(REMOVAL_MODES)}."
        )


def _require_points(cloud: PointCloud, counts: IngestCounts, least_points: int) -> None:
    if len(cloud) < least_points:
        raise InputError(
            f"Only {len(cloud)} of {counts.read} points are usable, but a surface needs at least {least_points}."
        )


def _require_volume(points: Float, *, flat_ratio: float = 1e-4) -> None:
    """Refuse points that span no volume, since they define no closed surface.

    `flat_ratio` is the ratio of extents below which points count as lying in a plane or on a line: thinner than any
    scanned object, and above the rounding of coordinates.
    """
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[1] < flat_ratio * extents[0]:
        raise InputError("All points lie on one line, so they enclose no volume.")
    if extents[2] < flat_ratio * extents[0]:
        raise InputError("All points lie in one plane, so they enclose no volume.")
