"""Survey of a cloud: extent, spacing, noise, state of the normals, outliers and open borders.

A point lies at an open border where its neighbours, seen along the normal of their plane, leave a wide gap. The test
needs a gap for two numbers of neighbours: one of them may show a gap by chance, or where a sheet is thin or bends
sharply.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.local_pca import tangent_coordinates
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.clean import usable_positions
from gnrecon.ingest.ingest_parameters import IngestParameters, SurveyParameters
from gnrecon.ingest.isolated_clusters import isolated_clusters
from gnrecon.ingest.noise import estimate_noise
from gnrecon.ingest.orientation import flip_if_inward
from gnrecon.ingest.outliers import find_outliers
from gnrecon.ingest.repeated_points import repeated_points


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
    open : whether these are more than by chance; False where there are too few points to determine the noise
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
    points, first = np.unique(cloud.points[finite], axis=0, return_index=True)
    if len(points) <= min(limits.border_neighbours):
        return None
    rows = np.flatnonzero(finite)[first]
    distinct, repeated = len(points), repeated_points(points - points.mean(axis=0))
    points, rows = points[~repeated], rows[~repeated]
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
        density_variation=float(np.percentile(area, 95) / np.percentile(area, 5)),
        noise=noise.deviation,
        noise_limit=noise.limit,
        normals="missing" if cloud.normals is None else _state(thinned, cloud.normals[rows[chosen]], limits),
        border_share=border,
        open=border > limits.open_share and noise.deviation is not None,
        origins=0 if cloud.origins is None else len(np.unique(cloud.origins, axis=0)),
    )


def _spacings(points: Float, chosen: Int, neighbour: int) -> tuple[Float, Float]:
    """Return, at the chosen points, the distance to the nearest point and the square of that to the k-th."""
    from scipy.spatial import cKDTree

    distances = cKDTree(points).query(points[chosen], neighbour + 1)[0]
    return distances[:, 1], distances[:, -1] ** 2


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
    from scipy.spatial import cKDTree

    lengths = np.linalg.norm(normals, axis=1)
    usable = np.isfinite(lengths) & (lengths > 0)
    if 2 * usable.sum() < len(normals):
        return "zero"
    points, directions = points[usable], normals[usable] / lengths[usable, None]
    rows = cKDTree(points).query(points, min(9, len(points)))[1][:, 1:]
    agreeing = np.einsum("gki,gi->gk", directions[rows], directions) > 0
    if (agreeing.mean(axis=1) < 0.5).mean() > limits.disagreeing_share:
        return "inconsistent"
    if flip_if_inward(points, directions)[1]:
        return "inward"
    return "good" if (np.abs(lengths[usable] - 1) < limits.length_tolerance).all() else "unnormalised"
