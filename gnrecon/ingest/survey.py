"""Survey of a cloud: extent, spacing, noise, state of the normals, outliers and open borders.

A point lies at an open border where its neighbours, seen along the normal of their plane, leave a wide gap. The test
needs a gap for two numbers of neighbours: one of them may show a gap by chance, or where a sheet is thin or bends
sharply.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.local_pca import surface_variation, tangent_coordinates
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.clean import distinct_positions, unit_normals, usable_positions
from gnrecon.ingest.ingest_parameters import IngestParameters, SurveyParameters
from gnrecon.ingest.isolated_clusters import isolated_clusters
from gnrecon.ingest.noise import estimate_noise
from gnrecon.ingest.orientation import are_inconsistent, flip_if_inward
from gnrecon.ingest.orientation_methods import is_open, outwardness
from gnrecon.ingest.outliers import find_outliers
from gnrecon.ingest.repeated_points import repeated_points
from gnrecon.runtime.chunks import slices


@dataclass(frozen=True)
class Survey:
    """Facts of a cloud; lengths in file units.

    Parameters
    ----------
    points, non_finite, duplicates, repeated, clusters : numbers of points: all, unusable ones, those at
        the position of another, copies of others where a scan is contained twice, and those in isolated clusters
    outliers : their number among at most `SurveyParameters.points` of the others
    lower, upper : corners of the bounding box
    spacing, spacing_p5, spacing_p95 : distance to the nearest point: median, 5th and 95th percentile
    density_variation : ratio of the 95th to the 5th percentile of the points' density on the surface
    noise : standard deviation along the normal; 0 where there is none, None where it cannot be determined
    noise_limit : its upper limit, because part of the spread may be the surface's own
    normals : ``"missing"``, ``"zero"``, ``"unnormalised"``, ``"inconsistent"``, ``"inward"`` or ``"good"``
    border_share : share of the points at an open border
    open : whether these are more than by chance; False where there are too few points to tell
    origins : number of different positions of the scanner; 0 where they are unknown
    """

    points: int
    non_finite: int
    duplicates: int
    repeated: int
    outliers: int
    clusters: int
    lower: list[float]
    upper: list[float]
    spacing: float
    spacing_p5: float
    spacing_p95: float
    density_variation: float
    noise: float | None
    noise_limit: float
    normals: str
    border_share: float
    open: bool
    origins: int

    def as_dict(self) -> dict[str, Any]:
        """Return the facts by name."""
        return asdict(self)


def survey(cloud: PointCloud, *, parameters: IngestParameters = IngestParameters()) -> Survey | None:
    """Return the facts of a cloud, or None where fewer than 25 points are finite and distinct.

    Parameters
    ----------
    cloud : in file units
    parameters : tuning constants

    Raises
    ------
    InputError
        When the points extend too far or not far enough, see `usable_positions`.
    """
    limits = parameters.survey
    finite = usable_positions(cloud.points)
    if finite.sum() <= min(limits.border_neighbours):
        return None
    rows = np.flatnonzero(finite)[distinct_positions(cloud.points[finite])]
    points = cloud.points[rows]
    distinct, repeated = len(points), repeated_points(points - points.mean(axis=0))
    points, rows = points[~repeated], rows[~repeated]
    if len(points) <= min(limits.border_neighbours):
        return None
    chosen = np.random.default_rng(0).permutation(len(rows))[: limits.points]
    centred = points - points.mean(axis=0)
    nearest, area = _spacings(centred, chosen, limits.density_neighbour)
    thinned, spacing = centred[chosen], float(np.median(nearest))
    noise = estimate_noise(centred, spacing, parameters=parameters.noise)
    border = _border_share(thinned, limits)
    return Survey(
        points=len(cloud),
        non_finite=int((~finite).sum()),
        duplicates=int(finite.sum()) - distinct,
        repeated=int(repeated.sum()),
        outliers=int(find_outliers(thinned, parameters=parameters.outliers).sum()),
        clusters=int(isolated_clusters(centred, parameters=parameters.clusters).sum()),
        lower=points.min(axis=0).tolist(),
        upper=points.max(axis=0).tolist(),
        spacing=spacing,
        spacing_p5=float(np.percentile(nearest, 5)),
        spacing_p95=float(np.percentile(nearest, 95)),
        density_variation=_ratio(area),
        noise=noise.deviation,
        noise_limit=noise.limit,
        normals="missing" if cloud.normals is None else _state(centred, cloud.normals[rows], limits),
        border_share=border,
        open=border > limits.open_share and (noise.deviation is not None or len(points) >= limits.border_points),
        origins=0 if cloud.origins is None else len(np.unique(cloud.origins, axis=0)),
    )


def is_single_sheet(
    points: Float,
    normals: Float,
    *,
    least_facing_share: float = 0.97,
    least_facing_area: float = 0.98,
    most_outward: float = 0.5,
    least_points: int = 100,
    neighbours: int = 8,
    queries: int = 10_000,
) -> bool:
    """Return whether a scan is a single sheet that was seen from one side, such as terrain, a face or a wall.

    Its winding number is that of an open surface, without an inside, and nearly all of its points, or of its area, have
    normals within 90 degrees of their mean. A bowl or half of a sphere has an inside; objects on a ground have sides
    that face away. The walls of a house on terrain may have many points, but they have little area.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), outward unit normals
    least_facing_share, least_facing_area : shares of points and of area with normals within 90 degrees of the mean
    most_outward : magnitude of the `outwardness`; half of a sphere has 0.6, a face as a depth camera sees it 0.46
    least_points : fewer may be those of anything, so that the closed surface is the simplest
    neighbours : of a point, up to which it represents the area
    queries : random points at which the area is measured
    """
    if len(points) < least_points:
        return False
    from scipy.spatial import cKDTree

    some = np.random.default_rng(0).permutation(len(points))[:queries]
    areas = cKDTree(points).query(points[some], neighbours + 1)[0][:, -1] ** 2
    facing = normals[some] @ (areas @ normals[some]) > 0
    if (normals @ normals.mean(axis=0) > 0).mean() < least_facing_share and (
        areas[facing].sum() < least_facing_area * areas.sum()
    ):
        return False
    return is_open(outwardness(points - points.mean(axis=0), normals), most=most_outward)


def fill_a_volume(
    points: Float,
    *,
    neighbours: int = 64,
    near_neighbours: int = 8,
    queries: int = 2000,
    points_per_neighbour: int = 16,
    least: float = 0.15,
    least_near_share: float = 0.3,
) -> bool:
    """Return whether points fill a volume instead of lying on its surface.

    The surface variation of many neighbours is then 0.2 to 0.33, and that of the nearest ones at least 0.4 of it; on
    noisy and doubled surfaces the former is at most 0.1. Between walls as close as those of a foam, where it is 0.2,
    the nearest neighbours lie flat.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    neighbours : of a point, itself included; so many that noise is thin against their extent
    near_neighbours : the nearest of these
    queries : random points at which they are looked up
    points_per_neighbour : fewer points are not examined, because the neighbours would span the shape
    least : surface variation of all neighbours, in the median
    least_near_share : that of the nearest ones, as a share of it
    """
    if len(points) < points_per_neighbour * neighbours:
        return False
    from scipy.spatial import cKDTree

    some = np.random.default_rng(0).permutation(len(points))[:queries]
    near = cKDTree(points).query(points[some], neighbours)[1]
    variation = float(np.median(surface_variation(points[near])))
    of_nearest = float(np.median(surface_variation(points[near[:, :near_neighbours]])))
    return variation > least and of_nearest > least_near_share * variation


def outer_surface(
    points: Float,
    *,
    neighbours: int = 32,
    least_offset: float = 0.25,
    link_reaches: float = 0.75,
    least_part: float = 0.05,
    chunk_points: int = 50_000,
) -> tuple[Mask, Float]:
    """Return which points of a filled volume are at its surface, and outward unit normals there.

    The neighbours of a point at the surface are all on one side: their mean is 3/8 of their reach away from a point on
    a plane, and 0.14 in the root mean square from a point within random ones. By chance some inner points have as much;
    unlike those of a surface, they are not next to many others.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N > neighbours
    neighbours : of a point
    least_offset : of the neighbours' mean from a point at the surface, over their reach
    link_reaches : distance within which points belong to one surface, in median reaches of the neighbours
    least_part : points of a surface, over those of the largest one
    chunk_points : handled at a time, which bounds memory

    Returns
    -------
    A mask of shape (N,), and normals of shape (M, 3) of the M points in it.
    """
    from scipy.spatial import cKDTree

    tree, away, reach = cKDTree(points), np.empty_like(points), np.empty(len(points))
    for rows in slices(len(points), chunk_points):
        distances, near = tree.query(points[rows], neighbours + 1)
        away[rows], reach[rows] = points[rows] - points[near[:, 1:]].mean(axis=1), distances[:, -1]
    lengths = np.linalg.norm(away, axis=1)
    outer = lengths > least_offset * reach
    found = np.flatnonzero(outer)
    pairs = cKDTree(points[found]).query_pairs(link_reaches * float(np.median(reach)), output_type="ndarray")
    links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(found), len(found)))
    parts = connected_components(links, directed=False)[1]
    sizes = np.bincount(parts, minlength=1)
    outer[found] = sizes[parts] >= least_part * sizes.max()
    return outer, away[outer] / lengths[outer, None]


def _spacings(points: Float, chosen: Int, neighbour: int) -> tuple[Float, Float]:
    """Return, at the chosen points, the distance to the nearest point and the square of that to the k-th."""
    from scipy.spatial import cKDTree

    distances = cKDTree(points).query(points[chosen], neighbour + 1)[0]
    return distances[:, 1], distances[:, -1] ** 2


def _ratio(values: Float) -> float:
    """Return the ratio of the 95th to the 5th percentile of positive values, of which squares may have underflown."""
    low, high = np.maximum(np.percentile(values / values.max(), [5, 95]), np.finfo(np.float64).tiny)
    return float(high / low)


def _border_share(points: Float, limits: SurveyParameters) -> float:
    """Return the share of points at an open border."""
    from scipy.spatial import cKDTree

    rows = cKDTree(points).query(points, min(max(limits.border_neighbours) + 1, len(points)))[1]
    at_border = np.ones(len(points), bool)
    gap = np.radians(limits.border_gap_degrees)
    for count in limits.border_neighbours:
        local = tangent_coordinates(points[rows[:, : count + 1]])[:, 1:]
        angles = np.sort(np.arctan2(local[:, :, 1], local[:, :, 0]), axis=1)
        at_border &= np.diff(angles, axis=1, append=angles[:, :1] + 2 * np.pi).max(axis=1) > gap
    return float(at_border.mean())


def _state(points: Float, normals: Float, limits: SurveyParameters) -> str:
    """Return the most severe defect of the normals, or ``"good"``."""
    usable, directions = unit_normals(normals)
    if 2 * usable.sum() < len(normals):
        return "zero"
    points = points[usable]
    if are_inconsistent(points, directions):
        return "inconsistent"
    if flip_if_inward(points, directions)[1]:
        return "inward"
    # Clipped, so that squares do not overflow; what was longer still is longer than 1.
    lengths = np.linalg.norm(np.clip(normals[usable], -2.0, 2.0), axis=1)
    return "good" if (np.abs(lengths - 1) < limits.length_tolerance).all() else "unnormalised"
