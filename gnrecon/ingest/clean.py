"""Dropping what no surface can be fitted to, with a count for each reason."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.noise import neighbour_spacing
from gnrecon.ingest.outliers import MODES, find_outliers, outliers_by_rule, parse_outliers
from gnrecon.ingest.voxel_grid import cells_of
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


_NEAR_ALL = 10.0

_CELLS = 4
"""Cubes along the greatest distance of points that are together."""

_NEIGHBOURS = 16

_OWN = 4  # neighbours, the farthest of which tells a point's own spacing

_NEAR_OWN = 4.0

_SHARE = 0.01


# Isolated clusters: a few points together, off all others, as of dust, reflections or what stood in the background.
#
# Points are together where they are nearer than ten spacings of the cloud. Of the parts that this gives, those with
# fewer than one in a hundred points are looked at once more: they are joined to what is nearer than four of their own
# spacings, so that a region that was scanned thinly does not fall apart. One that is still a part is isolated if it is
# farther from the rest than it is large: a real part that is thin, or a strip whose surroundings were not seen, is
# longer than its gap. What has fewer than five points is left to the outliers.


def isolated_clusters(points: Float) -> Mask:
    """Return the mask, of shape (N,), of points in isolated clusters.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    """
    if len(points) <= _NEIGHBOURS:
        return np.zeros(len(points), bool)
    links = _near_links(points, _NEAR_ALL * neighbour_spacing(points))
    parts, small = _parts(links, len(points))
    if small.any():
        parts, small = _parts(np.hstack([links, _own_links(points, np.flatnonzero(small[parts]))]), len(points))
    # A part that stays may be what keeps another from being alone.
    while small.any() and not small.all():
        stays = small & ~_alone(points, parts, small)
        small &= ~stays
        if not stays.any():
            return small[parts]
    return np.zeros(len(points), bool)


def _parts(links: Int, count: int) -> tuple[Int, Mask]:
    """The number of each point's part, of shape (N,), and by part whether it is small."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph: Any = coo_matrix((np.ones(links.shape[1], np.int8), links), shape=(count, count))
    parts: Int = connected_components(graph, directed=False)[1].astype(np.intp)
    return parts, np.bincount(parts) < _SHARE * count


def _near_links(points: Float, reach: float) -> Int:
    """Pairs of rows, of shape (2, P), that link points nearer than `reach`, to within its fourth part.

    All points of a small cube are linked with its first one, and first ones among each other: there are few of them.
    """
    from scipy.spatial import cKDTree

    cells = cells_of(points, reach / _CELLS)
    first = np.unique(cells, return_index=True)[1]
    pairs = cKDTree(points[first]).query_pairs(reach, output_type="ndarray")
    return np.hstack([np.stack([np.arange(len(points)), first[cells]]), first[pairs].T])


def _own_links(points: Float, rows: Int) -> Int:
    """Pairs of rows, of shape (2, P), that link points in `rows` to what is near by their own spacing."""
    from scipy.spatial import cKDTree

    distances, neighbours = cKDTree(points).query(points[rows], _NEIGHBOURS + 1)
    near = distances <= _NEAR_OWN * distances[:, [_OWN]]
    first, column = np.nonzero(near)
    return np.stack([rows[first], neighbours[first, column]])


def _alone(points: Float, parts: Int, suspects: Mask) -> Mask:
    """Which of the suspected parts are farther from all that is not suspected than they are large; by part."""
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(suspects[parts])
    numbers, own = np.unique(parts[rows], return_inverse=True)
    gap, lower, upper = np.full(len(numbers), np.inf), *np.full((2, len(numbers), 3), np.inf)
    np.minimum.at(gap, own, cKDTree(points[~suspects[parts]]).query(points[rows])[0])
    np.minimum.at(lower, own, points[rows])
    np.minimum.at(upper, own, -points[rows])
    alone = np.zeros(len(suspects), bool)
    alone[numbers] = gap > np.linalg.norm(-upper - lower, axis=1)
    return alone


_CLOSE = 0.02  # of the distance to the sixteenth neighbour

_QUERIES = 20_000

_REPEAT_SHARE = 0.05
"""Of points that have a close one, from which on the scan is repeated."""


# A scan that is in a cloud twice, to within rounding: copies of points that no surface can tell apart.
#
# By chance two points of a surface may lie close together, but hardly ever a fiftieth of the way to their sixteenth
# neighbour: that holds for less than one point in a hundred. Where it does for many, the scan is repeated, as by files
# that were merged twice or posed by rounded numbers, and the first of each group stays. Spacing and noise would else be
# those of the copies. Repetitions that lie farther apart are layers (`layers`).


def repeated_points(points: Float) -> Mask:
    """Return the mask, of shape (N,), of points that repeat an earlier one; none where it is not the whole scan.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    tree, stride = cKDTree(points), -(-len(points) // _QUERIES)
    count = min(_NEIGHBOURS, len(points) - 1)
    if count < 1 or _close(tree, points[::stride], count)[1].any(axis=1).mean() < _REPEAT_SHARE:
        return np.zeros(len(points), bool)
    neighbours, close = _close(tree, points, count)
    rows, columns = np.nonzero(close)
    pairs = (np.ones(len(rows), np.int8), (rows, neighbours[rows, columns]))
    links: Any = coo_matrix(pairs, shape=(len(points), len(points)))
    groups = connected_components(links, directed=False)[1]
    mask = np.ones(len(points), bool)
    mask[np.unique(groups, return_index=True)[1]] = False
    return mask


def _close(tree: Any, queries: Float, count: int) -> tuple[Int, Mask]:
    """The nearest other points of each, of shape (Q, count), and which of them are as good as the same."""
    distances, neighbours = tree.query(queries, count + 1)
    return neighbours[:, 1:], distances[:, 1:] < _CLOSE * distances[:, -1:]
